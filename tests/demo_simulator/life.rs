//! Start, heartbeat, ports and end.

use std::net::TcpListener;
use std::time::{Duration, Instant};

use futures_util::StreamExt as _;
use nix::sys::signal::Signal;
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;

use super::simulator::{DEADLINE, PORT, Start, WORLD, own_address, project, small_project};

#[tokio::test]
async fn it_listens_at_once_and_beats_first_after_one_period() {
    let project = small_project();
    let started = Instant::now();
    let start = Start::paused(&project.path().join("worlds/a.wbt")).argument("--heartbeat=500");
    let mut simulator = start.listening().await;
    simulator.spectator().await;
    simulator.prints(&["."]).await;
    assert!(started.elapsed() >= Duration::from_millis(500));
    simulator.prints(&[".", "."]).await;
    assert!(started.elapsed() >= Duration::from_millis(1500));
}

#[tokio::test]
async fn a_client_that_comes_before_the_world_is_told_so_and_then_shown_it() {
    let project = project(&[]);
    let world = project.path().join("worlds/slow.wbt");
    mkfifo(&world, Mode::S_IRWXU).unwrap();
    let mut simulator = Start::paused(&world).argument("--heartbeat=10").listening().await;
    let mut viewer = simulator.viewer().await;
    viewer.say("w3d").await;
    viewer.hears(&["loading:Reading world file :0"]).await;
    simulator.prints(&[".", "."]).await;
    tokio::fs::write(&world, WORLD).await.unwrap();
    viewer.hears(&["loading:Parsing world:100", "loading:Finalizing nodes:100"]).await;
    viewer.hears(&["world:worlds/slow.wbt:", "model:", "application/json:", "scene load completed", "pause: 0"]).await;
    viewer.hears_nothing().await;
}

#[tokio::test]
async fn a_signal_ends_it_with_0_after_the_closing_handshake() {
    let project = small_project();
    for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT] {
        let mut simulator = Start::paused(&project.path().join("worlds/a.wbt")).listening().await;
        let viewer = simulator.spectator().await;
        let not_watching = simulator.viewer().await;
        simulator.signal(signal);
        // with any other code Webots' page shows a dialog
        for mut client in [viewer, not_watching] {
            client.is_closed(CloseCode::Normal).await;
            let end = timeout(DEADLINE, client.socket.next()).await.expect("the connection did not end in time");
            assert!(end.is_none(), "{end:?}");
        }
        assert_eq!(simulator.end().await.code(), Some(0), "{signal}");
    }
}

#[tokio::test]
async fn a_client_that_does_not_answer_delays_the_end_by_a_second_only() {
    let project = small_project();
    let mut simulator = Start::paused(&project.path().join("worlds/a.wbt")).listening().await;
    let silent = simulator.spectator().await;
    let signalled = Instant::now();
    simulator.signal(Signal::SIGTERM);
    assert_eq!(simulator.end().await.code(), Some(0));
    assert!(signalled.elapsed() >= Duration::from_secs(1), "the client had no time to answer");
    drop(silent);
}

#[tokio::test]
async fn a_taken_port_is_passed_over_silently() {
    let project = small_project();
    let world = project.path().join("worlds/a.wbt");
    let address = own_address();
    let first = Start::paused(&world).on(address).listening().await;
    let mut second = Start::paused(&world).on(address).argument("--heartbeat=1").listening().await;
    let third = Start::paused(&world).on(address).argument("--stderr").listening().await;
    assert_eq!([&first, &second, &third].map(|simulator| simulator.address.port()), [PORT, PORT + 1, PORT + 2]);
    for simulator in [&first, &second, &third] {
        simulator.spectator().await;
    }
    second.prints(&["."]).await;
    assert!(!second.printed().contains("stderr"));
    third.has_printed("stderr: WARNING: Could not listen to port").await;
}

#[tokio::test]
async fn with_eleven_ports_taken_it_gives_up() {
    let project = small_project();
    let address = own_address();
    let listeners: Vec<_> = (PORT..=PORT + 10).map(|port| TcpListener::bind((address, port)).unwrap()).collect();
    let mut simulator = Start::paused(&project.path().join("worlds/a.wbt")).on(address).spawn();
    assert_eq!(simulator.end().await.code(), Some(1));
    simulator.has_printed("stderr: webots: failed to open TCP server in the port range [21234-21244]").await;
    drop(listeners);
}

#[tokio::test]
async fn a_world_that_cannot_be_read_ends_it_with_a_failure() {
    let project = project(&[("notes.txt", WORLD)]);
    for name in ["missing.wbt", "notes.txt"] {
        let mut simulator = Start::paused(&project.path().join("worlds").join(name)).spawn();
        assert_eq!(simulator.end().await.code(), Some(1), "{name}");
        simulator.has_printed("stderr: webots: could not open file: '").await;
    }
}
