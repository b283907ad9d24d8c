//! The faults, each with its repair; here those of the fleet's processes. Each function undoes its fault before it
//! returns, except for what the fleet must repair itself.

use std::future::Future;
use std::pin::Pin;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use rand::RngExt;
use rand::rngs::SmallRng;

use crate::fleet::{Fleet, SERVERS};
use crate::support::instances_below;
use crate::support::relay::Mood;
use crate::support::stopwatch::Stopwatch;
use crate::surroundings::*;

type Injected<'fleet> = Pin<Box<dyn Future<Output = bool> + 'fleet>>;

/// A fault. `inject` returns whether it was possible.
pub struct Fault {
    pub name: &'static str,
    pub inject: for<'fleet> fn(&'fleet mut Fleet, &'fleet mut SmallRng) -> Injected<'fleet>,
}

/// Duration of a fault, for example of a stopped process.
pub const WHILE: Duration = Duration::from_secs(3);
/// Longest life of processes that a killed server leaves.
const AT_ONCE: Duration = Duration::from_secs(5);

macro_rules! faults {
    ($($name:literal: $function:expr;)*) => {
        vec![$(Fault { name: $name, inject: |fleet, random| Box::pin($function(fleet, random)) }),*]
    };
}

pub fn all() -> Vec<Fault> {
    faults! {
        "a session server is killed": kill_session;
        "a session server stands still": async |fleet, random| stand_still(fleet, random, true).await;
        "a simulation server is killed": kill_server;
        "a simulation server stands still": async |fleet, random| stand_still(fleet, random, false).await;
        "a Webots is killed": async |fleet, random| signal(fleet, random, "demo-simulator", Signal::SIGKILL).await;
        "a Webots stands still": async |fleet, random| signal(fleet, random, "demo-simulator", Signal::SIGSTOP).await;
        "a launcher is killed": async |fleet, random| signal(fleet, random, "/webots --batch", Signal::SIGKILL).await;
        "a launcher stands still": async |fleet, random| signal(fleet, random, "/webots --batch", Signal::SIGSTOP).await;
        "a git is killed": async |fleet, random| signal(fleet, random, "git --literal-pathspecs", Signal::SIGKILL).await;
        "a git stands still": async |fleet, random| signal(fleet, random, "git --literal-pathspecs", Signal::SIGSTOP).await;
        "the disk is full": fill_disk;
        "the cached repositories are gone": async |fleet, _| close_folder(fleet, "cache/git", true).await;
        "the cached repositories can't be written": async |fleet, _| close_folder(fleet, "cache/git", false).await;
        "the simulations' folders can't be written": async |fleet, _| close_folder(fleet, "cache/runs", false).await;
        "the log and its folder are gone": async |fleet, _| close_folder(fleet, "log", true).await;
        "the log and monitor.csv can't be written": async |fleet, _| close_folder(fleet, "log", false).await;
        "no more files can be opened": no_files;
        "clocks go forward an hour": async |fleet, _| step_clock(fleet, 3600).await;
        "clocks go back an hour": async |fleet, _| step_clock(fleet, -3600).await;
        "the name server hangs": async |fleet, _| break_names(fleet, Names::Hang).await;
        "the name server does not know a name": async |fleet, _| break_names(fleet, Names::AreUnknown).await;
        "the name server is gone": async |fleet, _| break_names(fleet, Names::HaveNoServer).await;
        "a link is cut": async |fleet, _| change_link(fleet, Mood::Cut).await;
        "a link is slow": async |fleet, _| change_link(fleet, Mood::Slow(Duration::from_millis(300))).await;
        "a link is silent": async |fleet, _| change_link(fleet, Mood::Silent).await;
        "a fifth of a server's packets are lost": async |fleet, random| lose_packets(fleet, random, 0.2).await;
        "all of a server's packets are lost": async |fleet, random| lose_packets(fleet, random, 1.0).await;
    }
}

async fn kill_session(fleet: &mut Fleet, _: &mut SmallRng) -> bool {
    fleet.session.signal(Signal::SIGKILL);
    fleet.session.ended().await;
    fleet.restart_session().await;
    true
}

async fn kill_server(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let index = random.random_range(0..SERVERS);
    fleet.servers[index].signal(Signal::SIGKILL);
    bury(fleet, index).await;
    fleet.restart(index).await;
    true
}

/// Waits until a killed server and all processes that it started have ended.
async fn bury(fleet: &mut Fleet, index: usize) {
    fleet.servers[index].ended().await;
    let stopwatch = Stopwatch::start();
    let ended = stopwatch.lap();
    while let rest @ [_, ..] = instances_below(&fleet.site.folder(index)).as_slice() {
        assert!(
            ended.elapsed() < AT_ONCE,
            "{AT_ONCE:?} after the server's end there is still {rest:?}"
        );
        actix_rt::time::sleep(Duration::from_millis(10)).await;
    }
}

async fn stand_still(fleet: &Fleet, random: &mut SmallRng, is_session: bool) -> bool {
    let index = random.random_range(0..SERVERS);
    let server = if is_session {
        &fleet.session
    } else {
        &fleet.servers[index]
    };
    server.signal(Signal::SIGSTOP);
    actix_rt::time::sleep(WHILE).await;
    server.signal(Signal::SIGCONT);
    true
}

/// Sends a signal to a process that a simulation server has started, with these words in its command line. Waits for
/// such a process, because clients come and go.
async fn signal(fleet: &Fleet, random: &mut SmallRng, words: &str, signal: Signal) -> bool {
    let deadline = Instant::now() + WHILE;
    while Instant::now() < deadline {
        let all = instances_below(fleet.site.root()).into_iter();
        let all: Vec<i32> = all
            .filter(|(_, command)| command.contains(words))
            .map(|(pid, _)| pid)
            .collect();
        if !all.is_empty() {
            return kill(Pid::from_raw(all[random.random_range(0..all.len())]), signal).is_ok();
        }
        // A git process runs for only some milliseconds.
        actix_rt::time::sleep(Duration::from_millis(2)).await;
    }
    false
}
