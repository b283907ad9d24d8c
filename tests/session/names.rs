//! Names of simulation servers whose lookup hangs.

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

use super::stand_in::{Manner, StandIn};
use super::until_states;
use crate::support::program::session_server;
use crate::support::stopwatch::Stopwatch;
use crate::support::{http, name_server, skip, until};

#[actix_rt::test]
async fn a_name_whose_lookup_hangs_holds_up_only_its_own_server() {
    const HANGING: usize = 20;
    let folder = tempfile::tempdir().unwrap();
    let address = name_server::free_address();
    let script = address.and_then(|address| Some((address, name_server::asking(address, folder.path())?)));
    let Some((address, script)) = script else {
        let why = "unshare --mount or port 53 is not allowed here";
        return skip("a_name_whose_lookup_hangs_holds_up_only_its_own_server", why);
    };
    // It never answers.
    let _name_server = UdpSocket::bind((address, 53)).unwrap();
    let well = StandIn::start(Manner::idle(5.0, 1000));
    let mut servers: Vec<String> = (0..HANGING).map(|number| format!("{number}.test:2000")).collect();
    servers.push(well.address());
    let builder = session_server(&servers).set("timing", serde_json::json!({"answer": 0.5})).set("clientCost", 0.001);
    let mut session = builder.before(&script).start().await;
    let states = |hanging| [vec![hanging; HANGING], vec!["up"]].concat();
    until_states(&session, &states("down")).await;
    assert!(session.log().contains("0.test:2000: down: no answer within 0.5 s"));
    // Some looks later, nothing has piled up, and the others are asked as ever.
    let threads = || procfs::process::Process::new(session.pid()).unwrap().stat().unwrap().num_threads;
    let before = threads();
    let (asked, begin) = (well.requests(), Instant::now());
    until("it is asked twenty times more", async || well.requests() >= asked + 20).await;
    let took = begin.elapsed();
    assert!(took < Duration::from_secs(5), "twenty looks, one each 0.1 s, took {took:?}");
    assert!(threads() <= before, "{} threads, {before} before", threads());
    let stopwatch = Stopwatch::start();
    for _ in 0..20 {
        let begin = stopwatch.lap();
        assert_eq!(http::get(&session.url("/session")).await.text(), well.url());
        assert!(begin.elapsed() < Duration::from_secs(1), "an answer took {:?}", begin.elapsed());
    }
    // Nobody waits for them at the end either.
    let begin = Instant::now();
    session.signal(Signal::SIGTERM);
    assert_eq!(session.ended().await, Some(0));
    assert!(begin.elapsed() < Duration::from_secs(5), "the end took {:?}", begin.elapsed());
}
