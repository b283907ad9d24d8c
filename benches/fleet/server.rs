//! The built session server as a child process, and small helpers to talk to it.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// A session server, killed on drop.
pub(crate) struct Server {
    child: Child,
    /// Its port on the loopback interface.
    pub(crate) port: u16,
    folder: tempfile::TempDir,
}

/// Raises the limit of open files as far as the system allows.
pub(crate) fn raise_file_limit() {
    let (_, hard) = getrlimit(Resource::RLIMIT_NOFILE).expect("the limit of open files");
    setrlimit(Resource::RLIMIT_NOFILE, hard, hard).expect("the limit of open files can be raised");
}

impl Server {
    /// Starts a session server that probes these simulation servers each second, and waits until all have reported.
    pub(crate) fn start(simulation_servers: &[String]) -> Self {
        Self::start_with(simulation_servers, &serde_json::json!({}))
    }

    /// As [`Server::start`], with more keys of the configuration.
    pub(crate) fn start_with(simulation_servers: &[String], keys: &serde_json::Value) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let port = free_port();
        let mut config = serde_json::json!({
            "server": "localhost", "ssl": false, "portRewrite": false, "bind": "127.0.0.1", "port": port,
            "simulationServers": simulation_servers, "clientCost": 0.25, "timing": {"placement": 0.05},
            "logDir": folder.path().join("log"),
        });
        for (key, value) in keys.as_object().expect("keys") {
            config[key] = value.clone();
        }
        let file = folder.path().join("config.json");
        std::fs::write(&file, config.to_string()).expect("the configuration can be written");
        let child = Command::new(env!("CARGO_BIN_EXE_session-server"))
            .arg(&file)
            .stdout(Stdio::null())
            .spawn()
            .expect("the session server starts");
        let server = Self { child, port, folder };
        let all_up = format!("webots_session_servers{{state=\"up\"}} {}", simulation_servers.len());
        server.wait_until(|server| server.page("/metrics").is_some_and(|page| page.contains(&all_up)));
        server
    }

    /// Waits until a condition holds.
    pub(crate) fn wait_until(&self, condition: impl Fn(&Self) -> bool) {
        let deadline = Instant::now() + Duration::from_mins(1);
        while !condition(self) {
            assert!(
                Instant::now() < deadline,
                "waited in vain for the session server; its log:\n{}",
                self.log()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Makes it reload its configuration, with this threshold.
    pub(crate) fn reread(&self, threshold: u8) {
        let file = self.folder.path().join("config.json");
        let text = std::fs::read_to_string(&file).expect("the configuration can be read");
        let mut config: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
        config["loadThreshold"] = threshold.into();
        std::fs::write(&file, config.to_string()).expect("the configuration can be written");
        kill(self.id(), Signal::SIGHUP).expect("the server runs");
    }

    fn id(&self) -> Pid {
        Pid::from_raw(i32::try_from(self.process()).expect("a process id"))
    }

    pub(crate) fn process(&self) -> u32 {
        self.child.id()
    }

    /// What it has logged.
    pub(crate) fn log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("log/session/output.log")).unwrap_or_default()
    }

    /// A whole response, including the headers.
    pub(crate) fn page(&self, path: &str) -> Option<String> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).ok()?;
        write!(
            stream,
            "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        )
        .ok()?;
        let mut text = String::new();
        stream.read_to_string(&mut text).ok()?;
        Some(text)
    }

    /// The processor time that it has used: in user code, and in all.
    pub(crate) fn processor_time(&self) -> (Duration, Duration) {
        let stat = procfs::process::Process::new(self.id().as_raw())
            .and_then(|process| process.stat())
            .expect("the server runs");
        let seconds = |ticks: u64| Duration::from_secs_f64(ticks as f64 / procfs::ticks_per_second() as f64);
        (seconds(stat.utime), seconds(stat.utime + stat.stime))
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.child.kill().expect("the server can be killed");
        self.child.wait().expect("the server has ended");
    }
}

fn free_port() -> u16 {
    let socket = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    socket.local_addr().expect("it is bound").port()
}
