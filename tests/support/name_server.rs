//! A real DNS server, dnsmasq, on its own address. It knows only names that a test sets, and forwards no query.

use std::net::{IpAddr, Ipv4Addr, TcpStream, UdpSocket};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::{SOON, skip};

/// The port of name servers in `/etc/resolv.conf`.
const PORT: u16 = 53;

/// The server. It is killed when this value is dropped.
pub struct NameServer {
    child: Option<Child>,
    folder: tempfile::TempDir,
    address: Ipv4Addr,
}

/// The command that creates a mount namespace, if this machine allows it: for root, or in a user namespace.
fn own_mounts() -> Option<&'static str> {
    let works = |command: &&str| {
        Command::new("sh")
            .args(["-c", &format!("{command} true")])
            .output()
            .unwrap()
            .status
            .success()
    };
    ["unshare --mount", "unshare --mount --map-root-user"]
        .into_iter()
        .find(works)
}

/// A loopback address for a name server of this process alone; `None` if this process may not use the port.
pub fn free_address() -> Option<Ipv4Addr> {
    static LAST: AtomicU8 = AtomicU8::new(0);
    let process = u8::try_from(std::process::id() % 250).unwrap();
    loop {
        let address = Ipv4Addr::new(127, 53, process, LAST.fetch_add(1, Ordering::Relaxed) + 1);
        match UdpSocket::bind((address, PORT)) {
            Ok(_) => return Some(address),
            // A process with the same id modulo 250 uses it.
            Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => {}
            Err(_) => return None,
        }
    }
}

/// A shell script that makes a server use the name server at this address; `None` if that is not possible.
pub fn asking(address: Ipv4Addr, folder: &std::path::Path) -> Option<String> {
    let file = folder.join("resolv.conf");
    std::fs::write(&file, format!("nameserver {address}\noptions timeout:1 attempts:1\n")).unwrap();
    let mount = format!("mount --bind {} /etc/resolv.conf && exec \"$0\" \"$@\"", file.display());
    Some(format!("exec {} sh -c '{mount}' \"$0\" \"$@\"", own_mounts()?))
}

impl NameServer {
    /// Starts a server that knows no names. Returns `None`, and reports why, if this machine does not allow it.
    pub fn start() -> Option<Self> {
        needs!("dnsmasq", None);
        let Some(address) = free_address().filter(|_| own_mounts().is_some()) else {
            skip("unshare --mount or port 53 is not allowed here");
            return None;
        };
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("hosts"), "").unwrap();
        let mut server = Self {
            child: None,
            folder,
            address,
        };
        server.start_again();
        Some(server)
    }

    /// Starts it at its address again.
    pub fn start_again(&mut self) {
        let user = nix::unistd::User::from_uid(nix::unistd::getuid()).unwrap().unwrap();
        let mut command = Command::new("dnsmasq");
        // Its answers have a TTL of ten minutes, as those of Docker Swarm do.
        command.args([
            "--keep-in-foreground",
            "--conf-file=/dev/null",
            "--no-resolv",
            "--no-hosts",
            "--local-ttl=600",
        ]);
        command.args(["--bind-interfaces", "--local=/test/", "--pid-file="]);
        command
            .arg(format!("--listen-address={}", self.address))
            .arg(format!("--user={}", user.name));
        command.arg(format!("--addn-hosts={}", self.folder.path().join("hosts").display()));
        self.child = Some(command.stdin(Stdio::null()).spawn().unwrap());
        // A signal before it listens would end it.
        let deadline = Instant::now() + SOON;
        while TcpStream::connect((self.address, PORT)).is_err() {
            assert!(Instant::now() < deadline, "dnsmasq does not listen");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// A script for [`Builder::before`](super::program::Builder::before) that makes a server use this name server.
    pub fn asked(&self) -> String {
        asking(self.address, self.folder.path()).unwrap()
    }

    /// Resolves this name to these addresses, and no other name.
    pub fn set(&self, name: &str, addresses: &[IpAddr]) {
        let lines: String = addresses.iter().map(|address| format!("{address} {name}\n")).collect();
        std::fs::write(self.folder.path().join("hosts"), lines).unwrap();
        self.signal(Signal::SIGHUP);
    }

    pub fn signal(&self, signal: Signal) {
        let child = self.child.as_ref().unwrap();
        kill(Pid::from_raw(i32::try_from(child.id()).unwrap()), signal).unwrap();
    }

    /// Kills it.
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
