//! What ends with a simulation at each level, and how it ends.

use std::process::Command;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::deeds::{Stage, as_nobody};
use super::network::levels;
use crate::simulation::scene::{gone_within, instance_folders, nothing_left, stages};
use crate::support::{Client, DEMO, Webots, instances_below, server_of, until};

/// The processes that have this word in their command line.
pub fn named(word: &str) -> Vec<i32> {
    let all = procfs::process::all_processes().unwrap().flatten();
    let has = |one: &procfs::process::Process| one.cmdline().is_ok_and(|words| words.iter().any(|one| one == word));
    all.filter(has).map(|one| one.pid()).collect()
}

/// An argument of `sleep` that identifies the process.
pub fn long() -> String {
    format!("1000.{}", rand::random::<u64>())
}

/// `stayed` is in the process group of its simulation, but has no mark; `left` has the mark; `hidden` has neither.
#[actix_rt::test]
async fn what_hides_on_purpose_ends_with_its_sandbox() {
    needs!("bwrap");
    for (level, reason, survivors) in [
        ("sandbox", "client", vec![]),
        ("sandbox", "kill", vec![]),
        // The level does not promise to end these.
        ("none", "client", vec!["left", "hidden"]),
        ("none", "stop", vec!["hidden"]),
        ("none", "kill", vec!["hidden"]),
    ] {
        let [stayed, left, hidden] = [long(), long(), long()];
        let webots = Webots::script(&format!(
            "(env -i sleep {stayed} &)\n(setsid sleep {left} &)\n(env -i setsid sleep {hidden} &)\n{DEMO} \"$@\" & wait"
        ));
        let mut server = server_of(webots, 1)
            .set("isolation", level)
            .set("timing.grace", 0.5)
            .start()
            .await;
        let client = Client::ready(&server).await;
        let all = [("stayed", &stayed), ("left", &left), ("hidden", &hidden)];
        let alive = || -> Vec<&str> {
            all.into_iter()
                .filter(|(_, word)| !named(word).is_empty())
                .map(|(name, _)| name)
                .collect()
        };
        until("they hide", async || alive().len() == 3).await;
        match reason {
            "client" => client.leave().await,
            "stop" => server.stops().await,
            _ => {
                server.signal(Signal::SIGKILL);
                server.ended().await;
            }
        }
        until(&format!("{level}, {reason}: there is only {survivors:?}"), async || {
            alive() == survivors
        })
        .await;
        until("its folder is gone", async || {
            instance_folders(&server.folder).is_empty()
        })
        .await;
        assert_eq!(alive(), survivors, "{level}, {reason}");
        for pid in all.into_iter().flat_map(|(_, word)| named(word)) {
            kill(Pid::from_raw(pid), Signal::SIGKILL).unwrap();
        }
    }
}

#[actix_rt::test]
async fn a_simulation_has_its_grace_time_at_each_level() {
    needs!("bwrap");
    for (level, user, network) in levels() {
        let stage = Stage::new();
        let open = stage.elsewhere.path().to_str().unwrap();
        let written = stage.elsewhere.path().join("written");
        // Like Webots' launcher: it forwards SIGTERM, and waits.
        let work = format!("sleep 0.3; echo saved > '{}'", written.display());
        let webots = Webots::script(&format!("trap \"{work}; exit 0\" TERM\n{DEMO} \"$@\" & wait"));
        let builder = stage
            .builder(&webots, level)
            .before(user)
            .set("sandbox.network", network);
        let server = builder
            .set("sandbox.writable", open)
            .set("timing.grace", 10)
            .start()
            .await;
        let client = Client::ready(&server).await;
        client.leave().await;
        nothing_left(&server, 2).await;
        assert_eq!(
            std::fs::read_to_string(&written).unwrap_or_default(),
            "saved\n",
            "{level}, {network}"
        );
    }
}

#[actix_rt::test]
async fn a_simulation_that_ignores_sigterm_is_killed() {
    needs!("bwrap");
    for (level, user, network) in levels() {
        let stage = Stage::new();
        let webots = Webots::script(&format!(
            "trap '' TERM\n{DEMO} \"$@\" &\nwhile true; do wait; sleep 0.1; done"
        ));
        let builder = stage
            .builder(&webots, level)
            .before(user)
            .set("sandbox.network", network);
        let server = builder.set("maxConnections", 1).start().await;
        let client = Client::ready(&server).await;
        let left = Instant::now();
        client.leave().await;
        let took = gone_within(0.5, left, &server).await;
        assert!(
            took >= Duration::from_millis(500),
            "{level}, {network}: it was killed after {took:?}"
        );
    }
}

#[actix_rt::test]
async fn folders_of_simulations_are_removed_once_there_is_room_for_processes_again() {
    // The limit does not apply to root.
    let Some(nobody) = as_nobody() else { return };
    let stage = Stage::new();
    let webots = Webots::launcher();
    let server = stage.builder(&webots, "none").before(nobody).start().await;
    let clients = [Client::ready(&server).await, Client::ready(&server).await];
    let limit = |processes: &str| {
        // Root may lack the capability for processes of others.
        let pid = server.pid().to_string();
        let most = format!("--nproc={processes}:");
        let mut prlimit = Command::new("bash");
        prlimit.args(["-c", nobody, "prlimit", "--pid", &pid, &most]);
        assert!(prlimit.status().unwrap().success());
    };
    limit("1");
    for client in clients {
        client.leave().await;
    }
    let gone = async || stages(&server).await.is_empty() && instances_below(&server.folder).is_empty();
    until("the simulation has ended", gone).await;
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(2) {
        assert_eq!(instance_folders(&server.folder).len(), 2);
        actix_rt::time::sleep(Duration::from_millis(100)).await;
    }
    limit("1000");
    nothing_left(&server, 2).await;
}
