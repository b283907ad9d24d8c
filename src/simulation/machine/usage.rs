//! CPU and memory of each simulation: from its control group, otherwise from its process tree, or from a source of its
//! isolation level.
//!
//! One pass over `/proc` serves all simulations and all callers, at most once in 1.8 s, and only on demand.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use procfs::process::{Stat, all_processes};

/// The processes of a simulation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tree {
    /// The root of the process tree.
    pub root: i32,
    /// The directory of their control group, if they have one.
    pub cgroup: Option<PathBuf>,
}

/// The resource usage of a simulation's processes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Usage {
    /// Percent of one core: what Docker reports, or a mean since the last reading, `None` at the first.
    pub cpu: Option<f64>,
    /// Memory in bytes: what their control group is charged for, or the resident memory, in which memory that processes
    /// share counts for each.
    pub memory: u64,
    /// Number of processes and threads.
    pub threads: u64,
    /// CPU time so far, including child processes that have exited; zero if Docker reports the usage.
    pub time: Duration,
}

/// Readings of process trees, by the process at the root.
pub type Usages = BTreeMap<i32, Usage>;

/// Reads process trees on demand.
#[derive(Debug, Clone, Default)]
pub struct UsageMonitor(Arc<Mutex<Readings>>);

#[derive(Debug, Default)]
struct Readings {
    read: Option<Instant>,
    /// The trees of that reading. Some may have no usage.
    roots: BTreeSet<i32>,
    usages: Usages,
}

/// Time for which a reading is cached.
const AGE: Duration = Duration::from_millis(1800);

impl UsageMonitor {
    /// The usage of each of these trees, never much older than two seconds. Blocks for some milliseconds.
    pub fn read(&self, trees: &[Tree]) -> Usages {
        self.read_by(&trees.iter().map(|tree| tree.root).collect::<Vec<_>>(), || sums_of(trees))
    }

    /// The same for simulations whose processes only `measure` finds. It is called if the last reading is too old, and
    /// leaves out the use of the CPU unless it knows it.
    pub fn read_by(&self, roots: &[i32], measure: impl FnOnce() -> Usages) -> Usages {
        if roots.is_empty() {
            return Usages::new();
        }
        let mut last = self.0.lock();
        let known = roots.iter().all(|root| last.roots.contains(root));
        if known && last.read.is_some_and(|read| read.elapsed() < AGE) {
            return last.usages.clone();
        }
        last.roots = roots.iter().copied().collect();
        let mut usages = measure();
        // If Docker hangs, this may have taken longer than a reading is cached.
        let passed = last.read.map(|read| read.elapsed().as_secs_f64()).filter(|passed| *passed > 0.0);
        last.read = Some(Instant::now());
        for (root, usage) in &mut usages {
            let before = last.usages.get(root).zip(passed);
            let mean =
                before.map(|(before, passed)| 100.0 * usage.time.saturating_sub(before.time).as_secs_f64() / passed);
            usage.cpu = usage.cpu.or(mean);
        }
        last.usages.clone_from(&usages);
        usages
    }
}

fn sums_of(trees: &[Tree]) -> Usages {
    let mut processes = None;
    let sums = trees.iter().map(|Tree { root, cgroup }| {
        let sum = cgroup.as_deref().and_then(cgroup_sum);
        (*root, sum.unwrap_or_else(|| tree_sum(*root, processes.get_or_insert_with(all_by_parent))))
    });
    sums.collect()
}

/// The usage of a cgroup v2 so far; `None` if the kernel does not count all of it there.
fn cgroup_sum(folder: &Path) -> Option<Usage> {
    let (memory, threads) = (number_in(&folder.join("memory.current"))?, number_in(&folder.join("pids.current"))?);
    Some(Usage { cpu: None, memory, threads, time: cgroup_time(folder)? })
}

/// The CPU time of all that has run in a cgroup v2.
pub fn cgroup_time(folder: &Path) -> Option<Duration> {
    let times = std::fs::read_to_string(folder.join("cpu.stat")).ok()?;
    let time = times.lines().find_map(|line| line.strip_prefix("usage_usec "))?;
    time.trim().parse().ok().map(Duration::from_micros)
}

/// The number in a file of the kernel.
pub fn number_in(file: &Path) -> Option<u64> {
    std::fs::read_to_string(file).ok()?.trim().parse().ok()
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
    let (mut seen, mut open, mut sum) = (HashSet::new(), vec![root], Usage::default());
    while let Some(pid) = open.pop() {
        for stat in below.get(&pid).into_iter().flatten().filter(|stat| seen.insert(stat.pid)) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_simulation_without_a_reading_is_not_asked_for_again_at_once() {
        let (monitor, mut asked) = (UsageMonitor::default(), 0);
        let mut read = |roots: &[i32]| {
            let usages = monitor.read_by(roots, || {
                asked += 1;
                Usages::from([(1, Usage::default())])
            });
            (usages.into_keys().collect::<Vec<_>>(), asked)
        };
        let begin = Instant::now();
        assert_eq!(read(&[1, 2]), (vec![1], 1));
        let again = read(&[1, 2]);
        // A machine may be suspended for longer than a reading is cached.
        assert!(again == (vec![1], 1) || begin.elapsed() >= AGE, "{again:?}");
        assert_eq!(read(&[1, 2, 3]).1, again.1 + 1, "a new simulation is read at once");
    }

    #[test]
    fn a_control_group_is_read_where_it_counts_everything() {
        let group = tempfile::tempdir().unwrap();
        let me = i32::try_from(std::process::id()).unwrap();
        let read = || UsageMonitor::default().read(&[Tree { root: me, cgroup: Some(group.path().to_owned()) }])[&me];
        std::fs::write(group.path().join("cpu.stat"), "usage_usec 5000000\nuser_usec 1\n").unwrap();
        std::fs::write(group.path().join("pids.current"), "7777\n").unwrap();
        assert_ne!(read().threads, 7777, "there is no memory.current");
        std::fs::write(group.path().join("memory.current"), "123\n").unwrap();
        assert_eq!(read(), Usage { cpu: None, memory: 123, threads: 7777, time: Duration::from_secs(5) });
    }
}
