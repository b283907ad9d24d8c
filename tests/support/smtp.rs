//! A real SMTP server, in Python. `tests/python.sh` prepares it.

use std::io::{BufRead, BufReader, Read};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use serde_json::{Value, json};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

use super::SOON;

/// An SMTP server. It is killed when this value is dropped.
pub struct Smtp {
    child: Child,
    events: UnboundedReceiver<Value>,
    /// Every event that it has reported so far.
    pub told: Vec<Value>,
    pub port: u16,
}

impl Smtp {
    /// Starts a server with these options of `smtp_server.py`.
    pub async fn start(options: &[&str]) -> Self {
        let mut child = Command::new(python())
            .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/support/smtp_server.py"))
            .args(options)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the SMTP server starts");
        let (sender, events) = unbounded_channel();
        let output = child.stdout.take().unwrap();
        let errors = child.stderr.take().unwrap();
        tell_lines(output, sender.clone(), |line| serde_json::from_str(&line).unwrap());
        tell_lines(errors, sender, |line| json!({"stderr": line}));
        let mut server = Self {
            child,
            events,
            told: Vec::new(),
            port: 0,
        };
        let port = server.wait_for("port").await;
        server.port = u16::try_from(port.as_u64().unwrap()).unwrap();
        server
    }

    pub async fn mail(&mut self) -> Mail {
        Mail(self.wait_for("mail").await)
    }

    /// Waits until it reports an event with this key; returns the value.
    pub async fn wait_for(&mut self, key: &str) -> Value {
        let end = tokio::time::Instant::now() + SOON;
        loop {
            let Ok(event) = tokio::time::timeout_at(end, self.events.recv()).await else {
                panic!("no {key} came; the SMTP server told {:?}", self.told);
            };
            let event = event.unwrap_or_else(|| panic!("the SMTP server ended; it told {:?}", self.told));
            self.told.push(event.clone());
            if let Some(value) = event.get(key) {
                return value.clone();
            }
        }
    }

    /// Waits until it has reported an event with this key this many times.
    pub async fn wait_for_times(&mut self, key: &str, times: usize) {
        while self.count(key) < times {
            self.wait_for(key).await;
        }
    }

    /// The number of events with this key so far.
    pub fn count(&mut self, key: &str) -> usize {
        while let Ok(event) = self.events.try_recv() {
            self.told.push(event);
        }
        self.told.iter().filter(|event| event.get(key).is_some()).count()
    }

    /// The SMTP commands so far, as `NAME`, or `NAME*` if they were encrypted.
    pub fn commands(&mut self) -> Vec<String> {
        self.count("command");
        let commands = self.told.iter().filter(|event| event.get("command").is_some());
        commands
            .map(|event| {
                let name = event["command"].as_str().unwrap();
                if event["encrypted"] == true {
                    format!("{name}*")
                } else {
                    name.to_owned()
                }
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
pub struct Mail(Value);

impl Mail {
    pub fn field(&self, name: &str) -> &str {
        self.0[name].as_str().unwrap_or_else(|| panic!("no {name} in {self:?}"))
    }

    pub fn recipients(&self) -> Vec<&str> {
        self.0["to"]
            .as_array()
            .unwrap()
            .iter()
            .map(|to| to.as_str().unwrap())
            .collect()
    }

    /// The values of a header.
    pub fn header(&self, name: &str) -> Vec<&str> {
        let headers = self.0["headers"].as_array().unwrap().iter();
        headers
            .filter(|header| header[0] == name)
            .map(|header| header[1].as_str().unwrap())
            .collect()
    }

    pub fn subject(&self) -> &str {
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
