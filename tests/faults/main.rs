//! Faults under load: five simulation servers, a session server and a small class that comes and goes, while servers are
//! killed and stopped, disks are full, memory runs out, clocks step, names hang, packets are lost. After each fault the
//! fleet must be whole again by itself, but for a server that was killed, which its service manager starts again: here, the
//! test. Some faults need root, others iptables: what is not possible is said.
//!
//! `FAULTS_FOR=1h FAULTS_SEED=7 cargo test --test faults -- --nocapture` plays it for longer, or again.

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

#[path = "../support/mod.rs"]
mod support;

mod class;
mod fault;
mod fleet;
mod full_disk;
mod machine;
mod network;
mod returning;
mod surroundings;

use std::time::{Duration, Instant};

use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

use fault::Fault;
use fleet::Fleet;
use network::Network;

/// How long faults are injected where nothing else is asked for.
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
    let end = Instant::now() + time;
    let class = fleet.class(time + Duration::from_secs(20));
    let mut injected: Vec<&str> = Vec::new();
    // Each fault once, in any order, and then any.
    let mut open = fault::all();
    while Instant::now() < end {
        if open.is_empty() {
            open = fault::all();
        }
        let fault: Fault = open.swap_remove(random.random_range(0..open.len()));
        actix_rt::time::sleep(Duration::from_millis(random.random_range(100..1500))).await;
        let began = Instant::now();
        eprintln!("{:>7.1} s  {}", fleet.age(), fault.name);
        if !(fault.inject)(&mut fleet, &mut random).await {
            eprintln!("{:>7.1} s  {}: not possible here", fleet.age(), fault.name);
            continue;
        }
        injected.push(fault.name);
        let checked = fleet.whole(fault.name).await;
        eprintln!("{:>7.1} s  {}: whole after {:.1} s", fleet.age(), fault.name, (checked - began).as_secs_f64());
    }
    let report = class.end().await;
    eprintln!(
        "{:.0} s: {} simulations asked for, {} ran; {} faults of {} kinds; invariants checked {} times",
        fleet.age(),
        report["seats"]["asked"],
        report["seats"]["given"],
        injected.len(),
        injected.iter().collect::<std::collections::BTreeSet<_>>().len(),
        fleet.checks,
    );
    fleet.empty().await;
    assert!(report["seats"]["given"].as_u64().unwrap() > 0, "no simulation ran: {report}");
}
