//! Simulation servers found by DNS, with a real DNS server.

use std::net::IpAddr;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::{Value, json};

use super::stand_in::{Manner, StandIn};
use super::{times_logged, until_states};
use crate::support::name_server::NameServer;
use crate::support::program::{Builder, Server, session_server};
use crate::support::stopwatch::Stopwatch;
use crate::support::{http, ports, until};

fn good() -> Manner {
    Manner::idle(5.0, 1000)
}

/// Addresses of the loopback.
fn loopback(last: impl IntoIterator<Item = u8>) -> Vec<IpAddr> {
    last.into_iter().map(|last| [127, 0, 0, last].into()).collect()
}

fn stand_ins(addresses: &[IpAddr], port: u16) -> Vec<StandIn> {
    addresses
        .iter()
        .map(|address| StandIn::start_on((*address, port).into(), good()))
        .collect()
}

/// A session server that looks these entries up.
fn looking_up(entries: &[String], names: &NameServer) -> Builder {
    session_server(entries).before(&names.asked()).set("clientCost", 0.001)
}

/// The address and state of each server, from `/status`.
async fn servers(session: &Server) -> Vec<(String, String)> {
    let status = session.status().await;
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let servers = status["servers"].as_array().unwrap();
    servers
        .iter()
        .map(|server| (text(&server["address"]), text(&server["state"])))
        .collect()
}

#[actix_rt::test]
async fn servers_behind_a_name_come_and_go() {
    let Some(names) = NameServer::start() else { return };
    let port = ports::block(1);
    let mut first = stand_ins(&loopback([2, 3]), port);
    names.set("fleet.test", &loopback([2, 3]));
    let fixed = StandIn::start(good());
    let session = looking_up(&[fixed.address()], &names).start().await;
    session.reload(json!({"simulationServers": [fixed.address(), format!("dns+Fleet.test:{port}")]}));
    until_states(&session, &["up"; 3]).await;
    assert_eq!(
        servers(&session).await[0].0,
        fixed.address(),
        "in the order of the configuration"
    );

    // More servers are listed, one of them with an IPv6 address.
    let (third, fourth): (IpAddr, IpAddr) = ([127, 0, 0, 4].into(), "::1".parse().unwrap());
    let _more = stand_ins(&[third, fourth], port);
    let begin = Instant::now();
    names.set("fleet.test", &[loopback([2, 3]), vec![third, fourth]].concat());
    until_states(&session, &["up"; 5]).await;
    assert!(
        begin.elapsed() < Duration::from_secs(5),
        "used after {:?}",
        begin.elapsed()
    );
    assert!(
        servers(&session)
            .await
            .iter()
            .any(|(address, _)| *address == format!("[::1]:{port}"))
    );

    // One is no longer listed but still answers: no client is sent there.
    let leaving = first.remove(0);
    names.set("fleet.test", &[loopback([3]), vec![third, fourth]].concat());
    until_states(&session, &["up"; 4]).await;
    assert!(
        servers(&session)
            .await
            .iter()
            .all(|(address, _)| *address != leaving.address())
    );
    for _ in 0..20 {
        assert_ne!(http::get(&session.url("/session")).await.text(), leaving.url());
    }
    // It is listed again, then removed for good.
    names.set("fleet.test", &[loopback([2, 3]), vec![third, fourth]].concat());
    until_states(&session, &["up"; 5]).await;
    names.set("fleet.test", &[loopback([3]), vec![third, fourth]].concat());
    until_states(&session, &["up"; 4]).await;
    let address = leaving.address();
    drop(leaving);
    assert_eq!(times_logged(&session, &format!("{address}: no longer watched")), 2);
    assert_eq!(
        times_logged(&session, &format!("{address}: down")),
        0,
        "to leave is no failure"
    );
    // One that fails, and is then no longer listed, is forgotten.
    drop(first.pop());
    until_states(&session, &["up", "down", "up", "up"]).await;
    names.set("fleet.test", &[third, fourth]);
    until_states(&session, &["up"; 3]).await;
    session.reload(json!({"simulationServers": [fixed.address()]}));
    until_states(&session, &["up"]).await;
    assert_eq!(session.status().await["names"], json!([]));
}

#[actix_rt::test]
async fn a_failed_lookup_keeps_the_servers_and_is_logged_once() {
    let Some(mut names) = NameServer::start() else {
        return;
    };
    let port = ports::block(1);
    let servers = stand_ins(&loopback([2, 3]), port);
    names.set("fleet.test", &loopback([2, 3]));
    let name = format!("dns+fleet.test:{port}");
    let session = looking_up(std::slice::from_ref(&name), &names)
        .set("timing", json!({"placement": 0.2}))
        .set("loadRefresh", 0.02)
        .start()
        .await;
    until_states(&session, &["up"; 2]).await;
    let error = async || session.status().await["names"][0]["error"].clone();
    let stopwatch = Stopwatch::start();
    for (outage, words) in [(0, "timed out"), (1, "no such records"), (2, "")] {
        match outage {
            0 => names.signal(Signal::SIGSTOP),
            1 => names.set("another.test", &loopback([2, 3])),
            _ => names.end(),
        }
        until("the page tells it", async || error().await.as_str().is_some()).await;
        assert!(error().await.as_str().unwrap().contains(words), "{}", error().await);
        let page = session.monitor().await;
        assert!(page.contains(&format!("{name} can't be looked up.")), "{page}");
        // The session server repeats the lookup, and no client waits for it.
        let asked = servers[0].requests();
        while servers[0].requests() < asked + 40 {
            let begin = stopwatch.lap();
            let given = http::get(&session.url("/session")).await.text();
            assert!(given.starts_with("ws://127.0.0."), "{given}");
            assert!(
                begin.elapsed() < Duration::from_secs(1),
                "an answer took {:?}",
                begin.elapsed()
            );
            actix_rt::time::sleep(Duration::from_millis(20)).await;
        }
        until_states(&session, &["up"; 2]).await;
        let told = |words: &str| times_logged(&session, &format!("{name}: {words}"));
        let logged = (told("can't be looked up"), told("can be looked up again"));
        assert_eq!(logged, (outage + 1, outage), "{}", session.log());
        match outage {
            0 => names.signal(Signal::SIGCONT),
            1 => names.set("fleet.test", &loopback([2, 3])),
            _ => {
                names.start_again();
            }
        }
        until("the page tells that it works", async || error().await.is_null()).await;
    }
    assert_eq!(times_logged(&session, "no longer watched"), 0);
}

#[actix_rt::test]
async fn a_thousand_servers_are_found_behind_one_name() {
    let Some(names) = NameServer::start() else { return };
    let port = ports::block(1);
    let addresses: Vec<IpAddr> = (0..1000)
        .map(|number| [127, 1, (number / 250) as u8, (number % 250) as u8 + 1].into())
        .collect();
    let _servers = stand_ins(&addresses, port);
    names.set("fleet.test", &addresses);
    let builder = looking_up(&[format!("dns+fleet.test:{port}")], &names);
    let session = builder
        .set("loadRefresh", 600)
        .set("timing", json!({"answer": 15}))
        .start()
        .await;
    let metrics = async |line: String| session.metrics().await.lines().any(|one| one == line);
    until("all are found", async || {
        metrics("webots_session_servers{state=\"up\"} 1000".to_owned()).await
    })
    .await;
    assert!(
        metrics(format!(
            "webots_session_lookup_servers{{name=\"dns+fleet.test:{port}\"}} 1000"
        ))
        .await
    );
    names.set("fleet.test", &addresses[..500]);
    until("half of them are gone", async || {
        metrics("webots_session_servers{state=\"up\"} 500".to_owned()).await
    })
    .await;
}

#[actix_rt::test]
async fn a_name_whose_lookup_hangs_holds_up_only_its_own_server() {
    const HANGING: usize = 20;
    let Some(names) = NameServer::start() else { return };
    names.signal(Signal::SIGSTOP);
    let well = StandIn::start(good());
    let mut servers: Vec<String> = (0..HANGING).map(|number| format!("{number}.test:2000")).collect();
    servers.push(well.address());
    let builder = looking_up(&servers, &names)
        .set("timing", json!({"answer": 2}))
        .set("loadRefresh", 0.05);
    let mut session = builder.start().await;
    until_states(&session, &[vec!["down"; HANGING], vec!["up"]].concat()).await;
    assert!(session.log().contains("0.test:2000: down: no answer within 2 s"));
    // After some polls, no threads have piled up, no lookup has one of its own, and the other server is polled as before.
    let threads = || {
        let process = procfs::process::Process::new(session.pid()).unwrap();
        process.stat().unwrap().num_threads
    };
    let before = threads();
    assert!(before < HANGING as i64, "{before} threads");
    let asked = well.requests();
    let begin = Instant::now();
    until("it is asked twenty times more", async || well.requests() >= asked + 20).await;
    let took = begin.elapsed();
    // If each waited for a lookup that hangs, they would take 40 s.
    assert!(
        took < Duration::from_secs(20),
        "twenty looks, one each 0.05 s, took {took:?}"
    );
    assert!(threads() <= before, "{} threads, {before} before", threads());
    // The pending lookups don't delay the stop either.
    let begin = Instant::now();
    session.stops().await;
    assert!(
        begin.elapsed() < Duration::from_secs(5),
        "the end took {:?}",
        begin.elapsed()
    );
}
