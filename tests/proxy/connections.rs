//! Long connections: quiet times, and web servers that are told to read their configuration again or are restarted.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::time::Duration;

use futures_util::StreamExt;

use super::fleet::{Fleet, IDLE};
use super::rules::Rules;
use crate::support::SOON;
use crate::support::client::{Client, Heard};

/// Longer than the web server's patience.
const QUIET: Duration = Duration::from_millis(IDLE.as_millis() as u64 * 3 / 2);

async fn quiet_connections_last(rules: Rules) {
    let fleet = Fleet::start(rules).await;
    let browser = &fleet.browser;
    let mut door = browser.connect(&rules.session_path(fleet.session.port, "/session")).await;
    let mut idle = browser.open(&format!("{}/client", fleet.wss(&fleet.here))).await;
    let (mut client, stream) = fleet.simulate(browser, &fleet.there).await;
    let mut viewer = browser.open(&format!("{stream}/")).await.with_scene().await;
    viewer.send("pause").await;
    viewer.until("paused by client").await;
    // Nothing but pings goes over these connections; over Webots' stream not even these.
    assert!(idle.is_silent(QUIET).await, "{:?}", idle.heard);
    viewer.send("real-time:-1").await;
    viewer.until("application/json:").await;
    client.until(".").await;
    a_door_still_answers(&mut door).await;
}

/// With a URL; or with an error, if the machine that runs the tests is too busy for a simulation.
async fn a_door_still_answers(door: &mut Client) {
    door.send("").await;
    loop {
        match door.next().await {
            Heard::Text(text) if text.len() > 1 => return,
            Heard::Text(_) => {}
            Heard::Closed(frame) => panic!("closed: {frame:?}"),
        }
    }
}

through_both!(quiet_connections_last);

#[actix_rt::test]
async fn the_documents_rules_keep_what_is_pinged_and_cut_what_is_silent() {
    let fleet = Fleet::start(Rules::Documents).await;
    let mut door = fleet.browser.connect(&format!("/{}/session", fleet.session.port)).await;
    let (mut client, stream) = fleet.simulate(&fleet.browser, &fleet.here).await;
    let mut viewer = fleet.browser.open(&format!("{stream}/")).await.with_scene().await;
    viewer.closed().await;
    client.until(".").await;
    a_door_still_answers(&mut door).await;
}

/// What a live page is told, or the pictures of a Webots that streams a video.
async fn what_is_sent_in_pieces_comes_in_pieces(rules: Rules) {
    let fleet = Fleet::start(rules).await;
    let port = fleet.here.port + 2;
    let listener = TcpListener::bind(("127.0.0.1", port)).unwrap();
    let (next, wanted) = std::sync::mpsc::channel::<()>();
    let sender = std::thread::spawn(move || {
        let (mut connection, _) = listener.accept().unwrap();
        assert_ne!(connection.read(&mut [0; 4096]).unwrap(), 0);
        connection.write_all(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\n").unwrap();
        for piece in ["one", "two", "three"] {
            connection.write_all(format!("data: {piece}\n\n").as_bytes()).unwrap();
            wanted.recv_timeout(SOON).unwrap();
        }
    });
    let url = format!("https://{}/{port}/events", fleet.browser.host);
    let mut page = fleet.browser.begin(&url, &[]).await;
    for piece in ["one", "two", "three"] {
        let mut came = Vec::new();
        while !came.ends_with(b"\n\n") {
            let more = actix_rt::time::timeout(SOON, page.next()).await.expect("it is held back");
            came.extend_from_slice(&more.unwrap().unwrap());
        }
        assert_eq!(came, format!("data: {piece}\n\n").as_bytes());
        next.send(()).unwrap();
    }
    sender.join().unwrap();
}

through_both!(what_is_sent_in_pieces_comes_in_pieces);

async fn a_restart_costs_only_connections_of_its_own(rules: Rules) {
    let mut fleet = Fleet::start(rules).await;
    let (mut proxied, _) = fleet.simulate(&fleet.browser, &fleet.here).await;
    let mut direct = Client::start(&fleet.here, &super::fleet::arm()).await;
    direct.until("webots:").await;
    // It is read all the time, so that it answers pings, and ends if the connection does.
    let passing_by = actix_rt::spawn(async move {
        loop {
            if let Heard::Closed(frame) = direct.next().await {
                return frame;
            }
        }
    });
    // With a new certificate, say.
    fleet.web.reload();
    let (other, _) = fleet.simulate(&fleet.browser, &fleet.here).await;
    other.leave().await;
    for _ in 0..3 {
        proxied.until(".").await;
    }
    fleet.web.stop().await;
    proxied.closed().await;
    fleet.web.go().await;
    let (mut again, _) = fleet.simulate(&fleet.browser, &fleet.here).await;
    again.until(".").await;
    fleet.both_up().await;
    assert!(!passing_by.is_finished(), "a connection past the web server was closed: {:?}", passing_by.await);
}

through_both!(a_restart_costs_only_connections_of_its_own);
