//! CPU and memory of each simulation, from its process tree.
//!
//! One pass over `/proc` serves all simulations. It is made only on demand, at most every 1.8 s.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use procfs::process::{Stat, all_processes};

/// The resource usage of a simulation's processes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Usage {
    /// Percent of one core: what Docker reports, or a mean since the last reading; `None` at the first reading.
    pub cpu: Option<f64>,
    /// Memory in bytes: what Docker reports, or the sum of resident memory (shared memory counts for each process).
    pub memory: u64,
    /// Number of processes and threads.
    pub threads: u64,
    /// CPU time so far, including child processes that have exited; zero if Docker reports the usage.
    pub time: Duration,
}

/// Readings of process trees, by the process at the root.
pub type Usages = BTreeMap<i32, Usage>;

/// Keeps the last reading for the pages. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct UsageMonitor(Arc<Mutex<Option<(Instant, Usages)>>>);

/// Time for which a reading is kept.
const AGE: Duration = Duration::from_millis(1800);

impl UsageMonitor {
    /// The usage of all simulations, never much older than two seconds. `measure` is called if the last reading is too
    /// old; if it leaves `cpu` at `None`, the mean is computed.
    pub fn read(&self, measure: impl FnOnce() -> Usages) -> Usages {
        let mut last = self.0.lock();
        if let Some((at, usages)) = &*last
            && at.elapsed() < AGE
        {
            return usages.clone();
        }
        let mut usages = measure();
        for (root, usage) in &mut usages {
            let before = last
                .as_ref()
                .and_then(|(at, usages)| Some((at.elapsed(), usages.get(root)?)));
            let mean = before.map(|(passed, before)| {
                100.0 * usage.time.saturating_sub(before.time).as_secs_f64() / passed.as_secs_f64()
            });
            usage.cpu = usage.cpu.or(mean);
        }
        // If Docker hangs, this may have taken longer than a reading is kept.
        *last = Some((Instant::now(), usages.clone()));
        usages
    }
}

/// The usage of the process trees with these roots. Blocks for some milliseconds.
pub fn usages(roots: &[i32]) -> Usages {
    if roots.is_empty() {
        return Usages::new();
    }
    let below = all_by_parent();
    roots.iter().map(|root| (*root, tree_sum(*root, &below))).collect()
}

/// All processes, each below its parent and below the leader of its group.
fn all_by_parent() -> HashMap<i32, Vec<Stat>> {
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

/// The usage of a process, its group and all its descendants.
fn tree_sum(root: i32, below: &HashMap<i32, Vec<Stat>>) -> Usage {
    let mut seen = HashSet::new();
    let mut open = vec![root];
    let mut sum = Usage::default();
    while let Some(pid) = open.pop() {
        for stat in below
            .get(&pid)
            .into_iter()
            .flatten()
            .filter(|stat| seen.insert(stat.pid))
        {
            // Children that have exited count for their parent: a program that starts others one by one is busy, too.
            let waited = u64::try_from(stat.cutime.saturating_add(stat.cstime)).unwrap_or_default();
            sum.time += Duration::from_secs(stat.utime + stat.stime + waited) / ticks_per_second();
            sum.memory += stat.rss * procfs::page_size();
            sum.threads += u64::try_from(stat.num_threads).unwrap_or_default();
            open.push(stat.pid);
        }
    }
    sum
}

fn ticks_per_second() -> u32 {
    u32::try_from(procfs::ticks_per_second()).unwrap_or(100)
}
