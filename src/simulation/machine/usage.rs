//! CPU and memory of each simulation's process tree. Linux: `/proc`.
//!
//! One pass over all processes serves all simulations, at most once in 1.8 s, and only when somebody asks.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use procfs::process::{Stat, all_processes};

/// CPU and memory of a process tree.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Usage {
    /// Percent of one core, the mean since the reading before; nothing at the first.
    pub cpu: Option<f64>,
    /// Resident memory, in bytes; what processes share counts for each.
    pub memory: u64,
}

/// Readings of process trees, by the process at the root.
pub type Usages = BTreeMap<i32, Usage>;

/// Reads process trees for whoever asks.
#[derive(Debug, Clone, Default)]
pub struct UsageMonitor(Arc<Mutex<Readings>>);

#[derive(Debug, Default)]
struct Readings {
    read: Option<Instant>,
    ticks: HashMap<i32, u64>,
    usages: Usages,
}

/// How long a reading is cached.
const AGE: Duration = Duration::from_millis(1800);

impl UsageMonitor {
    /// The usage of each of these trees, never much older than two seconds.
    pub async fn read(&self, roots: Vec<i32>) -> Usages {
        if roots.is_empty() {
            return Usages::new();
        }
        let readings = Arc::clone(&self.0);
        let read = actix_rt::task::spawn_blocking(move || {
            let mut readings = readings.lock().unwrap_or_else(PoisonError::into_inner);
            readings.renew(&roots);
            readings.usages.clone()
        });
        read.await.unwrap_or_default()
    }
}

impl Readings {
    fn renew(&mut self, roots: &[i32]) {
        let passed = self.read.map(|read| read.elapsed());
        let known = roots.iter().all(|root| self.usages.contains_key(root));
        if known && passed.is_some_and(|passed| passed < AGE) {
            return;
        }
        self.read = Some(Instant::now());
        let processes = processes();
        let before = std::mem::take(&mut self.ticks);
        self.usages.clear();
        for root in roots {
            let (ticks, pages) = tree_sum(*root, &processes);
            let measured = before.get(root).zip(passed).filter(|(_, passed)| !passed.is_zero());
            let cpu = measured.map(|(before, passed)| cpu_percent(ticks.saturating_sub(*before), passed));
            self.ticks.insert(*root, ticks);
            self.usages.insert(*root, Usage { cpu, memory: pages * procfs::page_size() });
        }
    }
}

/// All processes, each below its parent and below the leader of its group.
fn processes() -> HashMap<i32, Vec<Stat>> {
    let mut below: HashMap<i32, Vec<Stat>> = HashMap::new();
    let all = all_processes().into_iter().flatten().flatten();
    for stat in all.filter_map(|process| process.stat().ok()) {
        if stat.pgrp != stat.ppid {
            below.entry(stat.pgrp).or_default().push(stat.clone());
        }
        below.entry(stat.ppid).or_default().push(stat);
    }
    below
}

/// How many processes and threads there are in the group of a process and among all that descends from it. Blocks.
#[must_use]
pub fn count_threads(root: i32) -> u64 {
    let below = processes();
    tree(root, &below).map(|stat| u64::try_from(stat.num_threads).unwrap_or_default()).sum()
}

/// CPU ticks and pages of memory of a process, of its group and of all that descends from it.
fn tree_sum(root: i32, below: &HashMap<i32, Vec<Stat>>) -> (u64, u64) {
    tree(root, below).fold((0, 0), |(ticks, pages), stat| (ticks + stat.utime + stat.stime, pages + stat.rss))
}

/// A process, its group and all that descends from it.
fn tree(root: i32, below: &HashMap<i32, Vec<Stat>>) -> impl Iterator<Item = &Stat> {
    let (mut seen, mut open, mut found) = (HashSet::new(), vec![root], Vec::new());
    while let Some(pid) = open.pop() {
        for stat in below.get(&pid).into_iter().flatten().filter(|stat| seen.insert(stat.pid)) {
            found.push(stat);
            open.push(stat.pid);
        }
    }
    found.into_iter()
}

#[expect(clippy::cast_precision_loss, reason = "a percentage needs no more digits than f64 has")]
fn cpu_percent(ticks: u64, passed: Duration) -> f64 {
    100.0 * ticks as f64 / procfs::ticks_per_second() as f64 / passed.as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[actix_rt::test]
    async fn a_busy_child_is_seen() {
        let mut child = std::process::Command::new("sh").args(["-c", "while :; do :; done"]).spawn().unwrap();
        let me = i32::try_from(std::process::id()).unwrap();
        let monitor = UsageMonitor::default();
        let first = monitor.read(vec![me]).await;
        assert_eq!(first[&me].cpu, None, "nothing to compare with");
        assert!(first[&me].memory > 10_000);
        let deadline = Instant::now() + Duration::from_secs(20);
        while monitor.read(vec![me]).await[&me].cpu.is_none_or(|cpu| cpu < 5.0) {
            assert!(Instant::now() < deadline, "it takes nothing");
            actix_rt::time::sleep(Duration::from_millis(100)).await;
        }
        child.kill().unwrap();
        child.wait().unwrap();
    }
}
