//! Faults of what is around the servers: disks, memory, clocks, names, links and ports.

use std::net::TcpListener;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use procfs::net::TcpState;
use procfs::process::{LimitValue, Process};
use rand::RngExt;
use rand::rngs::SmallRng;

use crate::fault::{WHILE, bury};
use crate::fleet::{BOUND, Fleet, PLACES, SERVERS, SMALL_DISK, try_start};
use crate::machine::LittleMemory;
use crate::support::disk::{Full, ReadOnly};
use crate::support::http;
use crate::support::relay::Mood;

/// What a server that runs out of memory may still take, with all that it starts, in bytes: less than one Webots.
const LITTLE: u64 = 2 << 20;

pub async fn fill_disk(fleet: &mut Fleet, _: &mut SmallRng) -> bool {
    let folder = fleet.folder(SMALL_DISK);
    let disk = nix::sys::statvfs::statvfs(&folder).unwrap();
    if disk.blocks() * disk.fragment_size() > 64 << 20 {
        return false;
    }
    let _full = Full::at(&folder);
    actix_rt::time::sleep(WHILE).await;
    true
}

/// A folder is replaced by one that can't be written, or can't be written any more.
pub async fn close_folder(fleet: &mut Fleet, name: &str, is_empty: bool) -> bool {
    let folder = fleet.folder(SMALL_DISK).join(name);
    let closed = if is_empty { ReadOnly::empty(&folder) } else { ReadOnly::at(&folder) };
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
        let mut command = std::process::Command::new("prlimit");
        let command = command.args(["--pid", &server.pid().to_string(), &format!("--nofile={soft}:{hard}")]);
        command.status().unwrap().success()
    };
    let is_possible = limit(server.fd_count().unwrap() as u64);
    actix_rt::time::sleep(WHILE).await;
    limit(soft) && is_possible
}

/// A server has no memory for another Webots. The system ends what takes the most: a simulation, or the server itself, which
/// is then started again.
pub async fn no_memory(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let index = random.random_range(0..SERVERS);
    let Some(little) = LittleMemory::of(fleet.servers[index].pid(), LITTLE) else {
        return false;
    };
    actix_rt::time::sleep(WHILE).await;
    drop(little);
    let deadline = Instant::now() + BOUND;
    loop {
        let state = Process::new(fleet.servers[index].pid()).and_then(|process| process.stat());
        if state.map_or(true, |stat| stat.state == 'Z') {
            bury(fleet, index).await;
            fleet.restart(index).await;
            return true;
        }
        if http::try_get(&fleet.servers[index].url("/health")).await.is_ok() {
            return true;
        }
        assert!(Instant::now() < deadline, "server {index} has memory again, and neither answers nor ends");
        actix_rt::time::sleep(Duration::from_millis(50)).await;
    }
}

/// The time of day of all servers makes a step, and one back.
pub async fn step_clock(fleet: &mut Fleet, seconds: i64) -> bool {
    fleet.clock.set(seconds);
    fleet.whole("the clock's step").await;
    actix_rt::time::sleep(WHILE).await;
    fleet.clock.set(0);
    true
}

/// What becomes of the name server.
#[derive(Clone, Copy)]
pub enum Names {
    Hang,
    AreUnknown,
    HaveNoServer,
}

/// Names fail, and the fleet is whole nevertheless.
pub async fn break_names(fleet: &mut Fleet, how: Names) -> bool {
    let Some(names) = &mut fleet.names else {
        return false;
    };
    match how {
        Names::Hang => names.signal(Signal::SIGSTOP),
        Names::AreUnknown => names.set("another.test", &[]),
        Names::HaveNoServer => names.end(),
    }
    // A name is looked up again every two seconds.
    actix_rt::time::sleep(WHILE).await;
    fleet.whole("names failed").await;
    match (how, &mut fleet.names) {
        (Names::Hang, Some(names)) => names.signal(Signal::SIGCONT),
        (Names::HaveNoServer, Some(names)) => names.start_again(),
        _ => fleet.set_name(),
    }
    true
}

pub async fn take_port(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let (index, first) = (random.random_range(0..SERVERS), random.random_range(0..PLACES));
    let mut ports = (first..first + PLACES).map(|place| fleet.port(index, place));
    let Some(_taken) = ports.find_map(|port| TcpListener::bind(("127.0.0.1", port)).ok()) else {
        return false;
    };
    actix_rt::time::sleep(WHILE).await;
    true
}

/// A server that is started again finds its port taken, and says so; then the port is free.
pub async fn take_own_port(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let index = random.random_range(0..SERVERS);
    fleet.servers[index].signal(Signal::SIGKILL);
    bury(fleet, index).await;
    {
        let _taken = TcpListener::bind(("127.0.0.1", fleet.servers[index].port)).unwrap();
        let mut refused = fleet.configured(index).spawn();
        let code = refused.ended().await;
        assert!(code.is_some_and(|code| code != 0), "{code:?}");
    }
    fleet.restart(index).await;
    true
}

/// The session server and one simulation server see each other through a link that changes.
pub async fn change_link(fleet: &mut Fleet, mood: Mood) -> bool {
    fleet.relay.set(mood);
    actix_rt::time::sleep(WHILE).await;
    fleet.relay.set(Mood::Open);
    true
}

/// Packets from and to a server are lost, for everybody.
pub async fn lose_packets(fleet: &mut Fleet, random: &mut SmallRng, share: f64) -> bool {
    let Some(network) = fleet.network else {
        return false;
    };
    let lost = network.lose(share, &[fleet.ports_of(random.random_range(0..SERVERS))]);
    actix_rt::time::sleep(WHILE).await;
    drop(lost);
    true
}

/// A client with a simulation is gone, and its server does not hear of it.
pub async fn half_open(fleet: &mut Fleet, random: &mut SmallRng) -> bool {
    let Some(network) = fleet.network else {
        return false;
    };
    let server = &fleet.servers[random.random_range(0..SERVERS)];
    // It may not have come back from the fault before.
    let Ok(client) = try_start(&format!("ws://{}", server.address())).await else {
        return false;
    };
    let port = client.port();
    let _lost = network.lose(1.0, &[port.to_string()]);
    drop(client);
    let is_open = || {
        let all = Process::new(server.pid()).and_then(|process| process.tcp()).unwrap();
        let mut known =
            all.iter().filter(|one| (one.local_address.port(), one.remote_address.port()) == (server.port, port));
        known.any(|one| one.state == TcpState::Established)
    };
    assert!(is_open(), "the server has heard that its client is gone");
    let deadline = Instant::now() + BOUND;
    while is_open() {
        assert!(Instant::now() < deadline, "{BOUND:?} after its end, a client is still believed in");
        actix_rt::time::sleep(Duration::from_millis(50)).await;
    }
    true
}
