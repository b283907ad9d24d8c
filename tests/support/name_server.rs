//! A real DNS server, dnsmasq, on a port of its own. It knows what a test says, and asks nobody.

use std::net::{IpAddr, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::{SOON, needs, ports};

/// The server. It ends with this value.
pub struct NameServer {
    child: Option<Child>,
    folder: tempfile::TempDir,
    port: u16,
    services: Vec<String>,
}

impl NameServer {
    /// Starts one that knows no name but those of these services, `NAME,TARGET,PORT`.
    pub fn start(services: &[String]) -> Self {
        needs("dnsmasq", "dnsmasq-base");
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("hosts"), "").unwrap();
        let mut server = Self { child: None, folder, port: ports::block(1), services: services.to_vec() };
        server.start_again();
        server
    }

    /// Starts it at its port, after it was ended.
    pub fn start_again(&mut self) {
        let user = nix::unistd::User::from_uid(nix::unistd::getuid()).unwrap().unwrap();
        let mut command = Command::new("dnsmasq");
        // What its answers say of themselves: that they hold for ten minutes, as those of Docker Swarm do.
        command.args(["--keep-in-foreground", "--conf-file=/dev/null", "--no-resolv", "--no-hosts", "--local-ttl=600"]);
        command.args(["--listen-address=127.0.0.1", "--bind-interfaces", "--local=/test/", "--pid-file="]);
        command.arg(format!("--port={}", self.port)).arg(format!("--user={}", user.name));
        command.arg(format!("--addn-hosts={}", self.folder.path().join("hosts").display()));
        command.args(self.services.iter().map(|service| format!("--srv-host={service}")));
        self.child = Some(command.stdin(Stdio::null()).spawn().unwrap());
        // Before it is there, a signal would end it.
        let deadline = Instant::now() + SOON;
        while TcpStream::connect(self.address()).is_err() {
            assert!(Instant::now() < deadline, "dnsmasq does not listen");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// `HOST:PORT`.
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    /// Has a name lead to these addresses, and knows no other.
    pub fn set(&self, name: &str, addresses: &[IpAddr]) {
        let lines: String = addresses.iter().map(|address| format!("{address} {name}\n")).collect();
        std::fs::write(self.folder.path().join("hosts"), lines).unwrap();
        self.signal(Signal::SIGHUP);
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: Signal) {
        let child = self.child.as_ref().unwrap();
        kill(Pid::from_raw(i32::try_from(child.id()).unwrap()), signal).unwrap();
    }

    /// Ends it.
    pub fn end(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }
}

impl Drop for NameServer {
    fn drop(&mut self) {
        self.end();
    }
}
