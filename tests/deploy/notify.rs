//! A service manager: it hears when a server is ready, reloads, stops, and that it is well.

use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use tokio::net::UnixDatagram;

use crate::support::git::Forge;
use crate::support::program::{Builder, Server, session_server, simulation_server};
use crate::support::webots::Webots;
use crate::support::{SOON, http};

/// Stands in for systemd.
struct Manager {
    folder: tempfile::TempDir,
    socket: UnixDatagram,
}

impl Manager {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = UnixDatagram::bind(folder.path().join("notify")).unwrap();
        Self { folder, socket }
    }

    fn start(&self, server: Builder) -> Server {
        server.env("NOTIFY_SOCKET", self.folder.path().join("notify").to_str().unwrap()).spawn()
    }

    /// The next message, within a time.
    async fn hear(&self, patience: Duration) -> Option<String> {
        let mut message = [0; 4096];
        let length = actix_rt::time::timeout(patience, self.socket.recv(&mut message)).await.ok()?.unwrap();
        Some(String::from_utf8(message[..length].to_vec()).unwrap())
    }

    async fn expect(&self, beginning: &str) -> String {
        let message = self.hear(SOON).await.unwrap_or_else(|| panic!("{beginning} was not told"));
        assert!(message.starts_with(beginning), "{message}");
        message
    }
}

#[actix_rt::test]
async fn a_session_server_tells_when_it_is_ready_and_stops() {
    let manager = Manager::new();
    let mut server = manager.start(session_server(&["localhost:1".to_owned()]));
    let ready = manager.expect("READY=1\n").await;
    assert!(ready.contains(&format!("STATUS=listens on port {}", server.port)), "{ready}");
    assert_eq!(http::try_get(&server.url("/health")).await.unwrap().status, 200, "at once");
    server.signal(Signal::SIGTERM);
    manager.expect("STOPPING=1\n").await;
    assert_eq!(server.ended().await, Some(0));
    assert_eq!(manager.hear(Duration::from_millis(1)).await, None);
}

#[actix_rt::test]
async fn a_simulation_server_tells_when_it_is_ready_drains_and_stops() {
    let (manager, forge, webots) = (Manager::new(), Forge::new(), Webots::script("exit 1"));
    let mut server = manager.start(simulation_server(&webots.path(), forge.path(), 1));
    manager.expect("READY=1\n").await;
    assert_eq!(http::try_get(&server.url("/health")).await.unwrap().status, 200, "at once");
    server.signal(Signal::SIGUSR1);
    manager.expect("STOPPING=1\nSTATUS=drained").await;
    assert_eq!(server.ended().await, Some(0));

    let mut other = manager.start(simulation_server(&webots.path(), forge.path(), 1));
    manager.expect("READY=1\n").await;
    other.signal(Signal::SIGTERM);
    manager.expect("STOPPING=1\nSTATUS=stopping").await;
    assert_eq!(other.ended().await, Some(0));
}

#[actix_rt::test]
async fn a_server_that_can_not_start_is_never_ready() {
    let (manager, taken) = (Manager::new(), std::net::TcpListener::bind("127.0.0.1:0").unwrap());
    let port = taken.local_addr().unwrap().port();
    let mut server = manager.start(session_server(&[]).set("port", port));
    assert_eq!(server.ended().await, Some(1));
    assert_eq!(manager.hear(Duration::from_millis(1)).await, None);
}

#[actix_rt::test]
async fn a_watchdog_is_fed_until_the_server_hangs() {
    let (forge, webots) = (Forge::new(), Webots::script("exit 1"));
    for server in [session_server(&[]), simulation_server(&webots.path(), forge.path(), 1)] {
        let manager = Manager::new();
        let mut server = manager.start(server.env("WATCHDOG_USEC", "300000"));
        manager.expect("READY=1\n").await;
        let begin = Instant::now();
        for _ in 0..10 {
            assert_eq!(manager.expect("WATCHDOG=1\n").await, "WATCHDOG=1\n");
        }
        assert!(begin.elapsed() > Duration::from_millis(500), "it is fed without pause");
        server.signal(Signal::SIGSTOP);
        while manager.hear(Duration::from_millis(300)).await.is_some() {}
        assert_eq!(manager.hear(Duration::from_millis(300)).await, None, "a server that hangs feeds it");
        server.signal(Signal::SIGCONT);
        manager.expect("WATCHDOG=1\n").await;
        server.stops().await;
    }
}
