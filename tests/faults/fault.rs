//! The faults, each with what heals it. Whatever is done to a fleet here is undone before the function returns, but for
//! what the fleet has to mend itself.

use std::collections::BTreeSet;
use std::future::Future;
use std::net::TcpListener;
use std::pin::Pin;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use procfs::process::Process;
use rand::RngExt;
use rand::rngs::SmallRng;

use crate::disk::{Full, ReadOnly};
use crate::fleet::{Fleet, SERVERS, SMALL_DISK};
use crate::relay::Mood;
use crate::support::program::Server;
use crate::support::webots::instances_below;

type Injected<'fleet> = Pin<Box<dyn Future<Output = bool> + 'fleet>>;

/// A fault. It tells whether it was possible.
pub struct Fault {
    pub name: &'static str,
    pub inject: for<'fleet> fn(&'fleet mut Fleet, &'fleet mut SmallRng) -> Injected<'fleet>,
}

/// How long something that stands still does so.
const WHILE: Duration = Duration::from_secs(3);
/// How long what a killed server leaves may live.
const AT_ONCE: Duration = Duration::from_secs(2);

macro_rules! faults {
    ($($name:literal: $function:expr;)*) => {
        vec![$(Fault { name: $name, inject: |fleet, random| Box::pin($function(fleet, random)) }),*]
    };
}

/// All faults.
pub fn all() -> Vec<Fault> {
    faults! {
        "a session server is killed": kill_session;
        "a session server stands still": stop_session;
        "a simulation server is killed": kill_server;
        "a simulation server stands still": stop_server;
        "a Webots is killed": async |fleet, random| signal(fleet, random, "demo-simulator", Signal::SIGKILL).await;
        "a Webots stands still": async |fleet, random| signal(fleet, random, "demo-simulator", Signal::SIGSTOP).await;
        "a launcher is killed": async |fleet, random| signal(fleet, random, "/webots --batch", Signal::SIGKILL).await;
        "a guardian is killed": async |fleet, random| signal(fleet, random, " guard ", Signal::SIGKILL).await;
        "a git is killed": async |fleet, random| signal(fleet, random, "git --literal-pathspecs", Signal::SIGKILL).await;
        "the disk is full": fill_disk;
        "the cached repositories can't be written": async |fleet, _| cover(fleet, "cache/git").await;
        "the log can't be written": async |fleet, _| cover(fleet, "log").await;
        "no more files can be opened": no_files;
        "a port is taken": take_port;
        "a link is cut": async |fleet, _| link(fleet, Mood::Cut).await;
        "a link is slow": async |fleet, _| link(fleet, Mood::Slow(Duration::from_millis(300))).await;
        "a link is silent": async |fleet, _| link(fleet, Mood::Silent).await;
    }
}

async fn kill_session(fleet: &mut Fleet, _: &mut SmallRng) -> bool {
    fleet.session.signal(Signal::SIGKILL);
    fleet.session.ended().await;
    fleet.restart_session().await;
    true
}

async fn stop_session(fleet: &mut Fleet, _: &mut SmallRng) -> bool {
    fleet.session.signal(Signal::SIGSTOP);
    actix_rt::time::sleep(WHILE).await;
    fleet.session.signal(Signal::SIGCONT);
    true
}

async fn kill_server(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let index = random.random_range(0..SERVERS);
    fleet.servers[index].signal(Signal::SIGKILL);
    fleet.servers[index].ended().await;
    let deadline = Instant::now() + AT_ONCE;
    while let rest @ [_, ..] = instances_below(&fleet.folder(index)).as_slice() {
        assert!(Instant::now() < deadline, "{AT_ONCE:?} after the server's end there is still {rest:?}");
        actix_rt::time::sleep(Duration::from_millis(10)).await;
    }
    fleet.restart(index).await;
    true
}

async fn stop_server(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let server = &fleet.servers[random.random_range(0..SERVERS)];
    server.signal(Signal::SIGSTOP);
    actix_rt::time::sleep(WHILE).await;
    server.signal(Signal::SIGCONT);
    true
}

/// Sends a signal to a process that the simulation servers have started, whose command line has these words. Waits for
/// one: clients come and go.
async fn signal(fleet: &Fleet, random: &mut SmallRng, words: &str, signal: Signal) -> bool {
    let deadline = Instant::now() + WHILE;
    while Instant::now() < deadline {
        let all = descendants(fleet, words);
        if !all.is_empty() {
            return kill(Pid::from_raw(all[random.random_range(0..all.len())]), signal).is_ok();
        }
        // A git lives for some milliseconds.
        actix_rt::time::sleep(Duration::from_millis(2)).await;
    }
    false
}

/// The processes below the simulation servers whose command line has these words.
fn descendants(fleet: &Fleet, words: &str) -> Vec<i32> {
    let all: Vec<(i32, i32, Process)> = procfs::process::all_processes()
        .unwrap()
        .flatten()
        .filter_map(|process| Some((process.pid(), process.stat().ok()?.ppid, process)))
        .collect();
    let mut family: BTreeSet<i32> = fleet.servers.iter().map(Server::pid).collect();
    loop {
        let before = family.len();
        family.extend(
            all.iter().filter(|(_, parent, _)| family.contains(parent)).map(|(pid, ..)| *pid).collect::<Vec<_>>(),
        );
        if family.len() == before {
            break;
        }
    }
    let is_one = |process: &Process| process.cmdline().is_ok_and(|command| command.join(" ").contains(words));
    let servers: BTreeSet<i32> = fleet.servers.iter().map(Server::pid).collect();
    all.into_iter()
        .filter(|(pid, _, process)| family.contains(pid) && !servers.contains(pid) && is_one(process))
        .map(|(pid, ..)| pid)
        .collect()
}

async fn fill_disk(fleet: &mut Fleet, _: &mut SmallRng) -> bool {
    let folder = fleet.folder(SMALL_DISK);
    let disk = nix::sys::statvfs::statvfs(&folder).unwrap();
    if disk.blocks() * disk.fragment_size() > 64 << 20 {
        return false;
    }
    let _full = Full::at(&folder);
    actix_rt::time::sleep(WHILE).await;
    true
}

async fn cover(fleet: &mut Fleet, name: &str) -> bool {
    let Some(_covered) = ReadOnly::at(&fleet.folder(SMALL_DISK).join(name)) else {
        return false;
    };
    actix_rt::time::sleep(WHILE).await;
    true
}

async fn no_files(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let pid = fleet.servers[random.random_range(0..SERVERS)].pid();
    let Ok(limits) = limit_files(pid, None) else {
        return false;
    };
    let open = Process::new(pid).and_then(|process| process.fd_count()).unwrap();
    limit_files(pid, Some((open as u64, limits.1))).unwrap();
    actix_rt::time::sleep(WHILE).await;
    limit_files(pid, Some(limits)).unwrap();
    true
}

/// Sets how many files a process may open, as soft and hard limit; returns what was.
fn limit_files(pid: i32, new: Option<(u64, u64)>) -> Result<(u64, u64), String> {
    let mut command = std::process::Command::new("prlimit");
    command.args(["--pid", &pid.to_string(), "--noheadings", "--raw", "--output", "SOFT,HARD"]);
    match new {
        Some((soft, hard)) => command.arg(format!("--nofile={soft}:{hard}")),
        None => command.arg("--nofile"),
    };
    let output = command.output().map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let mut numbers = text.split_whitespace().filter_map(|number| number.parse().ok());
    match (output.status.success(), numbers.next(), numbers.next()) {
        (true, Some(soft), Some(hard)) => Ok((soft, hard)),
        (true, ..) if new.is_some() => Ok(new.unwrap()),
        _ => Err(String::from_utf8_lossy(&output.stderr).into_owned()),
    }
}

async fn take_port(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let port = fleet.port(random.random_range(0..SERVERS), random.random_range(0..100));
    let Ok(_taken) = TcpListener::bind(("127.0.0.1", port)) else {
        return false;
    };
    actix_rt::time::sleep(WHILE).await;
    true
}

async fn link(fleet: &mut Fleet, mood: Mood) -> bool {
    fleet.relay.set(mood);
    actix_rt::time::sleep(WHILE).await;
    fleet.relay.set(Mood::Open);
    true
}
