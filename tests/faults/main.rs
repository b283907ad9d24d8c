//! Faults under load: five simulation servers, a session server and a small class that comes and goes, while servers
//! are killed and stopped, disks fill up, clocks step, DNS hangs, packets get lost. After each fault the fleet must
//! become whole again by itself; only killed servers are restarted by the test, in place of a service manager. Some
//! faults need root, others iptables; faults that are not possible are reported.
//!
//! `FAULTS_FOR=1h FAULTS_SEED=7 cargo test --test faults -- --nocapture` runs longer, or repeats a run.

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests fail by panics"
)]
#![allow(clippy::pedantic, reason = "tests are read one by one")]

#[macro_use]
#[path = "../support/mod.rs"]
mod support;

mod class;
mod fault;
mod fleet;
mod full_disk;
mod returning;
mod surroundings;

use std::time::{Duration, Instant};

use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

use fault::Fault;
use fleet::Fleet;
use support::network::Network;

/// Duration if `FAULTS_FOR` is not set.
const SHORT: Duration = Duration::from_secs(60);

#[actix_rt::test]
async fn the_fleet_is_whole_again_after_each_fault() {
    let time = std::env::var("FAULTS_FOR").map_or(SHORT, |text| humantime::parse_duration(&text).unwrap());
    let seed = std::env::var("FAULTS_SEED").map_or_else(|_| rand::random(), |text| text.parse::<u64>().unwrap());
    eprintln!("FAULTS_SEED={seed}");
    support::disk::hide_mounts_from_others();
    let network = Network::hide_from_others();
    let mut random = SmallRng::seed_from_u64(seed);
    let mut fleet = Fleet::start(network).await;
    fleet.whole("the start").await;
    let start = Instant::now();
    let class = fleet.class(time + Duration::from_secs(20));
    let mut injected: Vec<&str> = Vec::new();
    // Each fault once in random order, then again.
    let mut open = fault::all();
    while start.elapsed() < time {
        if open.is_empty() {
            open = fault::all();
        }
        let fault: Fault = open.swap_remove(random.random_range(0..open.len()));
        actix_rt::time::sleep(Duration::from_millis(random.random_range(100..1500))).await;
        let began = Instant::now();
        eprintln!("{:>7.1} s  {}", start.elapsed().as_secs_f64(), fault.name);
        if !(fault.inject)(&mut fleet, &mut random).await {
            eprintln!("           not possible here");
            continue;
        }
        injected.push(fault.name);
        fleet.whole(fault.name).await;
        eprintln!("           whole after {:.1} s", began.elapsed().as_secs_f64());
    }
    let seats = class.end().await["seats"].take();
    let kinds = injected.iter().collect::<std::collections::BTreeSet<_>>().len();
    eprintln!("{} faults of {kinds} kinds; simulations: {seats}", injected.len());
    fleet.empty().await;
    assert!(seats["given"].as_u64().unwrap() > 0, "no simulation ran: {seats}");
}
