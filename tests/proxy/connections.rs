//! Long connections: quiet times, and web servers that are told to read their configuration again or are restarted.

use std::time::Duration;

use super::fleet::{Fleet, IDLE};
use super::rules::Rules;
use crate::support::client::{Client, Heard};

/// Longer than the web server's patience.
const QUIET: Duration = Duration::from_millis(IDLE.as_millis() as u64 * 3 / 2);

async fn quiet_connections_last_and_live_pages_go_on(rules: Rules) {
    let fleet = Fleet::start(rules).await;
    let browser = &fleet.browser;
    let mut door = browser.connect(&rules.session_path(fleet.session.port, "/session")).await;
    let mut idle = browser.open(&format!("{}/client", fleet.wss(&fleet.here))).await;
    let (mut client, stream) = fleet.simulate(browser, &fleet.there).await;
    let mut viewer = browser.open(&format!("{stream}/")).await.with_scene().await;
    viewer.send("pause").await;
    viewer.until("paused by client").await;
    // Nothing but pings goes over these connections; over Webots' stream not even these.
    let live = super::pages::pages_are_live(&fleet, rules);
    let (is_silent, ()) = futures_util::join!(idle.is_silent(QUIET), live);
    assert!(is_silent, "{:?}", idle.heard);
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

through_both!(quiet_connections_last_and_live_pages_go_on);

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
