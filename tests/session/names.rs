//! Names of simulation servers whose lookup hangs.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use nix::sys::stat::Mode;

use super::stand_in::{Manner, StandIn};
use super::until_states;
use crate::support::program::session_server;
use crate::support::stopwatch::Stopwatch;
use crate::support::{http, skip, until};

/// How to get a view of the file system of one's own, if that is allowed here: for root, or with a user of one's own.
pub(super) fn own_mounts() -> Option<&'static str> {
    let works =
        |command: &&str| Command::new("sh").args(["-c", &format!("{command} true")]).output().unwrap().status.success();
    ["unshare --mount", "unshare --mount --map-root-user"].into_iter().find(works)
}

/// Has a server look up names in `hosts` of this folder alone. That is a pipe: who reads it waits for somebody to write.
fn hanging_names(unshare: &str, folder: &Path) -> String {
    nix::unistd::mkfifo(&folder.join("hosts"), Mode::S_IRWXU).unwrap();
    std::fs::write(folder.join("nsswitch.conf"), "hosts: files\n").unwrap();
    let mount = |name: &str| format!("mount --bind {}/{name} /etc/{name}", folder.display());
    let mounts = format!("{} && {} && exec \"$0\" \"$@\"", mount("hosts"), mount("nsswitch.conf"));
    format!("exec {unshare} sh -c '{mounts}' \"$0\" \"$@\"")
}

#[actix_rt::test]
async fn a_name_whose_lookup_hangs_holds_up_only_its_own_server() {
    const HANGING: usize = 20;
    let Some(unshare) = own_mounts() else {
        return skip("a_name_whose_lookup_hangs_holds_up_only_its_own_server", "unshare --mount is not allowed here");
    };
    let folder = tempfile::tempdir().unwrap();
    let [well, named] = [(); 2].map(|()| StandIn::start(Manner::idle(5.0, 1000)));
    let mut servers: Vec<String> = (0..HANGING).map(|number| format!("{number}.test:{}", named.port())).collect();
    servers.push(well.address());
    let builder = session_server(&servers).set("timing", serde_json::json!({"answer": 1})).set("clientCost", 0.001);
    let mut session = builder.before(&hanging_names(unshare, folder.path())).start().await;
    let states = |hanging| [vec![hanging; HANGING], vec!["up"]].concat();
    until_states(&session, &states("down")).await;
    let said = format!("0.test:{}: down: no answer within 1 s", named.port());
    assert!(session.log().contains(&said));
    // Some looks later, nothing has piled up, and the others are asked as ever.
    let threads = || procfs::process::Process::new(session.pid()).unwrap().stat().unwrap().num_threads;
    let (asked, begin) = (well.requests(), Instant::now());
    until("it is asked twenty times more", async || well.requests() >= asked + 20).await;
    let took = begin.elapsed();
    assert!(took < Duration::from_secs(5), "twenty looks, one each 0.1 s, took {took:?}");
    assert!((HANGING as i64..HANGING as i64 + 25).contains(&threads()), "{} threads", threads());
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
