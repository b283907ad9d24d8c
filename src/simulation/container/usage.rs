//! The resource usage of the containers of simulations: from their control groups, else from `docker stats`, once for
//! all.

use std::collections::BTreeMap;
use std::time::Duration;

use super::owned_resources::{PROJECT, ResourceOwner, quietly};
use crate::simulation::isolation::docker_cgroups;
use crate::simulation::machine::{Measured, Sum, Usage, cgroup_sum};

/// Measures the simulations of an owner: those on these ports, whose processes are named for each. Blocks for some
/// milliseconds; for two seconds where control groups can't be read.
#[must_use]
pub fn measure(owner: &ResourceOwner, roots: &BTreeMap<u16, i32>) -> Vec<(i32, Measured)> {
    let (filter, format) = (format!("label={PROJECT}"), format!("{{{{.ID}}}} {{{{.Label \"{PROJECT}\"}}}}"));
    let listed = quietly(&["ps", "--no-trunc", "--filter", &filter, "--format", &format]);
    let found = listed.lines().filter_map(|line| line.split_once(' '));
    let containers: BTreeMap<&str, i32> =
        found.filter_map(|(id, project)| Some((id, *roots.get(&owner.port_of(project)?)?))).collect();
    let sums: Option<Vec<(i32, Sum)>> = containers
        .iter()
        .map(|(id, root)| Some((*root, docker_cgroups(id).iter().find_map(|cgroup| cgroup_sum(cgroup))?)))
        .collect();
    match sums {
        Some(sums) => together(sums, add_sum).map(|(root, sum)| (root, Measured::Sum(sum))).collect(),
        None => {
            together(statistics(&containers), add_usage).map(|(root, usage)| (root, Measured::Usage(usage))).collect()
        }
    }
}

/// The sum of the readings of a simulation's containers.
fn together<T: Default>(readings: Vec<(i32, T)>, add: impl Fn(&mut T, T)) -> impl Iterator<Item = (i32, T)> {
    let mut all = BTreeMap::<i32, T>::new();
    for (root, reading) in readings {
        add(all.entry(root).or_default(), reading);
    }
    all.into_iter()
}

fn add_sum(all: &mut Sum, one: Sum) {
    *all = Sum { time: all.time + one.time, memory: all.memory + one.memory, threads: all.threads + one.threads };
}

fn add_usage(all: &mut Usage, one: Usage) {
    let cpu = Some(all.cpu.unwrap_or_default() + one.cpu.unwrap_or_default());
    *all = Usage { cpu, memory: all.memory + one.memory, threads: all.threads + one.threads, time: Duration::ZERO };
}

/// The usage of these containers from `docker stats`.
fn statistics(containers: &BTreeMap<&str, i32>) -> Vec<(i32, Usage)> {
    let format = "{{.ID}}\t{{.CPUPerc}}\t{{.MemUsage}}\t{{.PIDs}}";
    let words = ["stats", "--no-stream", "--no-trunc", "--format", format];
    let printed = quietly(&words.iter().copied().chain(containers.keys().copied()).collect::<Vec<_>>());
    printed.lines().filter_map(usage_of).filter_map(|(id, usage)| Some((*containers.get(id)?, usage))).collect()
}

/// A line of `docker stats`.
fn usage_of(line: &str) -> Option<(&str, Usage)> {
    let mut columns = line.split('\t');
    let id = columns.next()?;
    let cpu = columns.next()?.trim_end_matches('%').parse().ok();
    let memory = bytes(columns.next()?.split_once(" / ")?.0)?;
    Some((id, Usage { cpu, memory, threads: columns.next()?.parse().ok()?, time: Duration::ZERO }))
}

/// An amount such as `12.3MiB`.
fn bytes(amount: &str) -> Option<u64> {
    let (number, unit) = amount.split_at(amount.find(|letter: char| letter.is_ascii_alphabetic())?);
    let shift = ["B", "KiB", "MiB", "GiB", "TiB"].iter().position(|known| *known == unit)?;
    let bytes = number.parse::<f64>().ok()? * f64::from(1_u32 << 10).powi(i32::try_from(shift).ok()?);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "what a machine has fits")]
    bytes.is_finite().then_some(bytes as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_docker_is_read() {
        let usage = Usage { cpu: Some(12.5), memory: 12_897_484, threads: 7, time: Duration::ZERO };
        assert_eq!(usage_of("ab\t12.50%\t12.3MiB / 4GiB\t7"), Some(("ab", usage)));
        for line in ["ab\t--\t-- / --\t--", "", "ab\t1%\t12 / 13\t7", "ab\t1%\t1parsec / 2GiB\t7"] {
            assert_eq!(usage_of(line), None, "{line}");
        }
    }
}
