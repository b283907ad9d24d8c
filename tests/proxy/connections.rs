//! Long connections: idle times, live pages, and web servers that are reloaded or restarted.

use std::time::{Duration, Instant};

use futures_util::StreamExt;

use super::browser::Browser;
use super::fleet::{Fleet, IDLE};
use super::rules::Rules;
use crate::support::SOON;
use crate::support::client::{Client, Heard};

/// Longer than the web server's idle timeout.
const QUIET: Duration = Duration::from_millis(IDLE.as_millis() as u64 * 3 / 2);

/// Events are received at once, and for longer than the web server's idle timeout.
async fn is_told_what_happens(browser: &Browser, path: &str) {
    let url = format!("https://{}{path}", browser.host);
    let mut events = browser.begin(&url, &[("Accept", "text/event-stream")]).await;
    assert_eq!(events.status(), 200, "{path}");
    let begun = Instant::now();
    while begun.elapsed() < QUIET {
        let event = actix_rt::time::timeout(SOON, events.next())
            .await
            .expect("nothing is told");
        event.unwrap_or_else(|| panic!("{path}: the end")).unwrap();
    }
}

async fn a_web_server_keeps_quiet_connections(rules: Rules) {
    let mut fleet = Fleet::start(rules).await;
    quiet_connections_last(&fleet).await;
    restarts(&mut fleet).await;
}

through_both!(a_web_server_keeps_quiet_connections);

async fn quiet_connections_last(fleet: &Fleet) {
    let browser = &fleet.browser;
    let mut door = browser.connect("/session").await;
    let mut idle = browser.open(&format!("{}/client", fleet.wss(&fleet.here))).await;
    let (mut client, stream) = fleet.simulate(browser, &fleet.there).await;
    let mut viewer = browser.open(&format!("{stream}/")).await.with_scene().await;
    viewer.send("pause").await;
    viewer.until("paused by client").await;
    // Only pings are sent over these connections; over Webots' stream not even pings.
    let here = format!("/{}/events", fleet.here.port);
    let (is_silent, (), ()) = futures_util::join!(
        idle.is_silent(QUIET),
        is_told_what_happens(browser, &here),
        is_told_what_happens(browser, "/events")
    );
    assert!(is_silent, "{:?}", idle.heard);
    viewer.send("real-time:-1").await;
    viewer.until("application/json:").await;
    client.until(".").await;
    // The answer is a URL, or an error if this machine is too busy for a simulation.
    door.send("").await;
    while door.until("").await.len() == 1 {}
}

async fn restarts(fleet: &mut Fleet) {
    let (mut proxied, _) = fleet.simulate(&fleet.browser, &fleet.here).await;
    let mut direct = Client::start(&fleet.here, &super::fleet::arm()).await;
    direct.until("webots:").await;
    // Reads all the time, so that pings are answered; ends when the connection does.
    let passing_by = actix_rt::spawn(async move {
        loop {
            if let Heard::Closed(frame) = direct.next().await {
                return frame;
            }
        }
    });
    // As after the renewal of a certificate.
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
    assert!(
        !passing_by.is_finished(),
        "a connection past the web server was closed: {:?}",
        passing_by.await
    );
}
