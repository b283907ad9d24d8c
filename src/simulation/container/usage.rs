//! The resource usage of the containers of simulations, from `docker stats` once for all.

use std::collections::BTreeMap;
use std::time::Duration;

use super::docker::blocking;
use super::owned_resources::ResourceOwner;
use crate::simulation::machine::{Usage, Usages};

/// Timeout of the command.
const TIMEOUT: Duration = Duration::from_secs(20);

/// Measures the simulations of an owner: those on these ports, whose processes are named for each. Blocks for two
/// seconds, which `docker stats` takes.
pub fn measure(owner: &ResourceOwner, roots: &BTreeMap<u16, i32>) -> Usages {
    let format = "{{.Name}}\t{{.CPUPerc}}\t{{.MemUsage}}\t{{.PIDs}}";
    // Of all that run: one that is named and has ended meanwhile would fail all.
    let printed = blocking(&["stats", "--no-stream", "--format", format], TIMEOUT);
    let mut all = Usages::new();
    for (name, one) in printed.unwrap_or_default().lines().filter_map(usage_of) {
        let Some(root) = owner.port_of(name).and_then(|port| roots.get(&port)) else { continue };
        let sum = all.entry(*root).or_default();
        let cpu = Some(sum.cpu.unwrap_or_default() + one.cpu.unwrap_or_default());
        *sum = Usage { cpu, memory: sum.memory + one.memory, threads: sum.threads + one.threads, ..one };
    }
    all
}

/// A line of `docker stats`.
fn usage_of(line: &str) -> Option<(&str, Usage)> {
    let mut columns = line.split('\t');
    let name = columns.next()?;
    let cpu = columns.next()?.trim_end_matches('%').parse().ok();
    let memory = bytes(columns.next()?.split_once(" / ")?.0)?;
    Some((name, Usage { cpu, memory, threads: columns.next()?.parse().ok()?, time: Duration::ZERO }))
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
