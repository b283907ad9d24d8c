//! Faults in the servers' environment: disks, files, clocks, names and links.

use std::process::Command;

use nix::sys::signal::Signal;
use procfs::process::{LimitValue, Process};
use rand::RngExt;
use rand::rngs::SmallRng;

use crate::fault::WHILE;
use crate::fleet::{Fleet, SERVERS, SMALL_DISK};
use crate::support::disk::{Full, ReadOnly};
use crate::support::relay::Mood;

pub async fn fill_disk(fleet: &mut Fleet, _: &mut SmallRng) -> bool {
    let folder = fleet.site.folder(SMALL_DISK);
    let disk = nix::sys::statvfs::statvfs(&folder).unwrap();
    if disk.blocks() * disk.fragment_size() > 64 << 20 {
        return false;
    }
    let _full = Full::at(&folder);
    actix_rt::time::sleep(WHILE).await;
    true
}

/// Makes a folder read-only, either as it is or replaced by an empty one.
pub async fn close_folder(fleet: &mut Fleet, name: &str, is_empty: bool) -> bool {
    let folder = fleet.site.folder(SMALL_DISK).join(name);
    let closed = if is_empty {
        ReadOnly::empty(&folder)
    } else {
        ReadOnly::at(&folder)
    };
    if closed.is_none() {
        return false;
    }
    actix_rt::time::sleep(WHILE).await;
    true
}

pub async fn no_files(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let server = Process::new(fleet.servers[random.random_range(0..SERVERS)].pid()).unwrap();
    let limits = server.limits().unwrap().max_open_files;
    let (LimitValue::Value(soft), LimitValue::Value(hard)) = (limits.soft_limit, limits.hard_limit) else {
        return false;
    };
    let limit = |soft: u64| {
        let mut command = Command::new("prlimit");
        let command = command.args(["--pid", &server.pid().to_string(), &format!("--nofile={soft}:{hard}")]);
        command.status().unwrap().success()
    };
    let is_possible = limit(server.fd_count().unwrap() as u64);
    actix_rt::time::sleep(WHILE).await;
    limit(soft) && is_possible
}

/// The clock of all servers steps, and steps back.
pub async fn step_clock(fleet: &mut Fleet, seconds: i64) -> bool {
    fleet.site.clock.set(seconds);
    fleet.whole("the clock's step").await;
    actix_rt::time::sleep(WHILE).await;
    fleet.site.clock.set(0);
    true
}

/// Faults of the name server.
#[derive(Clone, Copy)]
pub enum Names {
    Hang,
    AreUnknown,
    HaveNoServer,
}

/// Names can't be resolved, but the fleet stays whole.
pub async fn break_names(fleet: &mut Fleet, how: Names) -> bool {
    let Some(names) = &mut fleet.site.names else {
        return false;
    };
    match how {
        Names::Hang => names.signal(Signal::SIGSTOP),
        Names::AreUnknown => names.set("another.test", &[]),
        Names::HaveNoServer => names.end(),
    }
    // Long enough for lookups, which run every second.
    actix_rt::time::sleep(WHILE).await;
    fleet.whole("names failed").await;
    match (how, &mut fleet.site.names) {
        (Names::Hang, Some(names)) => names.signal(Signal::SIGCONT),
        (Names::HaveNoServer, Some(names)) => names.start_again(),
        _ => fleet.site.set_name(),
    }
    true
}

/// Changes the link between the session server and one simulation server for a while.
pub async fn change_link(fleet: &mut Fleet, mood: Mood) -> bool {
    fleet.site.relay.set(mood);
    actix_rt::time::sleep(WHILE).await;
    fleet.site.relay.set(Mood::Open);
    true
}

/// Loses packets from and to a server, for all its peers.
pub async fn lose_packets(fleet: &mut Fleet, random: &mut SmallRng, share: f64) -> bool {
    let Some(network) = fleet.network else {
        return false;
    };
    let lost = network.lose(share, &[fleet.site.ports_of(random.random_range(0..SERVERS))]);
    actix_rt::time::sleep(WHILE).await;
    drop(lost);
    true
}
