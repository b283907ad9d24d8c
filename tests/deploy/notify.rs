//! Notifications of a service manager: ready, drained, stopping. `tests/deploy/package.sh` tests with a real systemd.

use nix::sys::signal::Signal;
use tokio::net::UnixDatagram;

use crate::support::program::{Builder, Server, demo_server, session_server};
use crate::support::{SOON, http};

/// Starts a server below a stand-in for systemd and sends it signals; the server sends these messages for each.
async fn tells(server: Builder, signals: &[(Signal, &[&str])]) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    let expect = async |beginning: &str| {
        let mut message = [0; 4096];
        let length = actix_rt::time::timeout(SOON, socket.recv(&mut message)).await;
        let length = length.unwrap_or_else(|_| panic!("{beginning} was not told")).unwrap();
        let message = String::from_utf8_lossy(&message[..length]);
        assert!(message.starts_with(beginning), "{message}");
    };
    let mut server: Server = server.env("NOTIFY_SOCKET", path.to_str().unwrap()).spawn();
    expect(&format!("READY=1\nSTATUS=listens on port {}", server.port)).await;
    assert_eq!(
        http::try_get(&server.url("/health")).await.unwrap().status,
        200,
        "at once"
    );
    for (signal, messages) in signals {
        server.signal(*signal);
        for message in *messages {
            expect(message).await;
        }
    }
    assert_eq!(server.ended().await, Some(0));
    assert!(socket.try_recv(&mut [0; 4096]).is_err(), "more is told");
}

#[actix_rt::test]
async fn a_service_manager_is_notified_of_readiness_and_stop() {
    tells(
        session_server(&["localhost:1".to_owned()]),
        &[(Signal::SIGTERM, &["STOPPING=1\n"])],
    )
    .await;
    let drained: (_, &[&str]) = (Signal::SIGUSR1, &["STOPPING=1\nSTATUS=drained"]);
    tells(demo_server(1), &[drained]).await;
    tells(demo_server(1), &[(Signal::SIGTERM, &["STOPPING=1\nSTATUS=stopping"])]).await;
}
