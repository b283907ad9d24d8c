//! The other side: a real SMTP server in Python, and the log lines of this process.

use std::io::{BufRead, BufReader, Read};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, Once};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tokio::net::TcpSocket;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

/// How long anything may take that is to happen.
pub(crate) const DEADLINE: Duration = Duration::from_secs(20);

/// An SMTP server. It ends with this value.
pub(crate) struct Smtp {
    child: Child,
    events: UnboundedReceiver<Value>,
    /// Everything it told so far.
    pub(crate) told: Vec<Value>,
    pub(crate) port: u16,
}

impl Smtp {
    /// Starts one with these options of `smtp_server.py`.
    pub(crate) async fn start(options: &[&str]) -> Self {
        let mut child = Command::new(python())
            .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/mail/smtp_server.py"))
            .args(options)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the SMTP server starts");
        let (sender, events) = unbounded_channel();
        let (output, errors) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
        tell_lines(output, sender.clone(), |line| serde_json::from_str(&line).unwrap());
        tell_lines(errors, sender, |line| json!({"stderr": line}));
        let mut server = Self { child, events, told: Vec::new(), port: 0 };
        let port = server.wait_for("port").await;
        server.port = u16::try_from(port.as_u64().unwrap()).unwrap();
        server
    }

    /// The next mail that arrives.
    pub(crate) async fn mail(&mut self) -> Mail {
        Mail(self.wait_for("mail").await)
    }

    /// Waits until it tells this, and gives back what.
    pub(crate) async fn wait_for(&mut self, key: &str) -> Value {
        let end = tokio::time::Instant::now() + DEADLINE;
        loop {
            let Ok(event) = tokio::time::timeout_at(end, self.events.recv()).await else {
                panic!("no {key} came; the SMTP server told {:?}, the log is {:#?}", self.told, log_lines());
            };
            let event = event.unwrap_or_else(|| panic!("the SMTP server ended; it told {:?}", self.told));
            self.told.push(event.clone());
            if let Some(value) = event.get(key) {
                return value.clone();
            }
        }
    }

    /// Waits until it is this often that it told this.
    pub(crate) async fn wait_for_times(&mut self, key: &str, times: usize) {
        while self.count(key) < times {
            self.wait_for(key).await;
        }
    }

    /// How often it told this, as far as it was read.
    pub(crate) fn count(&mut self, key: &str) -> usize {
        while let Ok(event) = self.events.try_recv() {
            self.told.push(event);
        }
        self.told.iter().filter(|event| event.get(key).is_some()).count()
    }

    /// The commands so far, as `NAME` or, where encrypted, `NAME*`.
    pub(crate) fn commands(&mut self) -> Vec<String> {
        self.count("command");
        let commands = self.told.iter().filter(|event| event.get("command").is_some());
        commands
            .map(|event| {
                let name = event["command"].as_str().unwrap();
                if event["encrypted"] == true { format!("{name}*") } else { name.to_owned() }
            })
            .collect()
    }
}

fn tell_lines(
    from: impl Read + Send + 'static,
    sender: UnboundedSender<Value>,
    value: impl Fn(String) -> Value + Send + 'static,
) {
    std::thread::spawn(move || {
        let lines = BufReader::new(from).lines().map_while(Result::ok);
        lines.map(value).try_for_each(|event| sender.send(event))
    });
}

impl Drop for Smtp {
    fn drop(&mut self) {
        self.child.kill().expect("the SMTP server can be ended");
        self.child.wait().expect("the SMTP server has ended");
    }
}

/// A mail that arrived.
#[derive(Debug)]
pub(crate) struct Mail(Value);

impl Mail {
    pub(crate) fn field(&self, name: &str) -> &str {
        self.0[name].as_str().unwrap_or_else(|| panic!("no {name} in {self:?}"))
    }

    pub(crate) fn recipients(&self) -> Vec<&str> {
        self.0["to"].as_array().unwrap().iter().map(|to| to.as_str().unwrap()).collect()
    }

    pub(crate) fn is_encrypted(&self) -> bool {
        self.0["encrypted"] == true
    }

    /// The values of a header.
    pub(crate) fn header(&self, name: &str) -> Vec<&str> {
        let headers = self.0["headers"].as_array().unwrap().iter();
        headers.filter(|header| header[0] == name).map(|header| header[1].as_str().unwrap()).collect()
    }

    pub(crate) fn subject(&self) -> &str {
        self.header("Subject")[0]
    }
}

fn python() -> PathBuf {
    let default = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/target/test-venv/bin/python"));
    let python = std::env::var_os("FLEET_TEST_PYTHON").map_or_else(default, PathBuf::from);
    assert!(
        python.is_file(),
        "{} is missing: run tests/python.sh, which makes it, or let FLEET_TEST_PYTHON name a Python with \
         tests/requirements.txt installed",
        python.display()
    );
    python
}

/// A port on which nobody listens, nor can anybody until the first value is dropped.
pub(crate) fn dead_port() -> (TcpSocket, u16) {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(([127, 0, 0, 1], 0).into()).unwrap();
    let port = socket.local_addr().unwrap().port();
    (socket, port)
}

/// A file for an authority's certificate that this process trusts.
///
/// Who is trusted comes with the environment of a process, so that the test is run again in one of its own: there this
/// gives back the file, here nothing once the other has succeeded.
pub(crate) fn trusted_authority(test: &str) -> Option<String> {
    let key = "SSL_CERT_FILE";
    let file = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("{test}-{}.pem", std::process::id()));
    let parent = std::env::var("FLEET_TEST_OWN_PROCESS").ok();
    if parent.as_deref() == Some(test) {
        return std::env::var(key).ok();
    }
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", &format!("mail::{test}"), "--nocapture"])
        .env(key, &file)
        .env("FLEET_TEST_OWN_PROCESS", test)
        .output()
        .unwrap();
    std::fs::remove_file(&file).expect("the SMTP server wrote its authority's certificate");
    let texts = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && texts.0.contains("1 passed"), "{}{}", texts.0, texts.1);
    None
}

static LOG: Mutex<Vec<(log::Level, String)>> = Mutex::new(Vec::new());

struct Keeper;

impl log::Log for Keeper {
    fn enabled(&self, metadata: &log::Metadata<'_>) -> bool {
        metadata.target().starts_with("webots_fleet")
    }

    fn log(&self, record: &log::Record<'_>) {
        if self.enabled(record.metadata()) {
            LOG.lock().unwrap().push((record.level(), record.args().to_string()));
        }
    }

    fn flush(&self) {}
}

/// Keeps the log lines of this process.
pub(crate) fn keep_log() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        log::set_logger(&Keeper).unwrap();
        log::set_max_level(log::LevelFilter::Debug);
    });
}

fn log_lines() -> Vec<(log::Level, String)> {
    LOG.lock().unwrap().clone()
}

/// The log lines of a level that name this port.
pub(crate) fn logged(level: log::Level, port: u16) -> Vec<String> {
    let needle = format!(":{port}");
    log_lines()
        .into_iter()
        .filter(|(other, line)| *other == level && line.contains(&needle))
        .map(|(_, line)| line)
        .collect()
}

/// Waits until there are so many log lines of a level that name this port, and gives them back.
pub(crate) async fn wait_for_log(level: log::Level, port: u16, least: usize) -> Vec<String> {
    let end = Instant::now() + DEADLINE;
    loop {
        let lines = logged(level, port);
        if lines.len() >= least {
            return lines;
        }
        assert!(Instant::now() < end, "no {least} lines of {level} about port {port} in {:#?}", log_lines());
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
