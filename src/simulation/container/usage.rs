//! The resource usage of the containers of simulations, from one call of `docker stats`.

use std::collections::BTreeMap;

use super::docker::{SHORT_TIMEOUT, docker_output};
use super::owned_resources::ResourceOwner;
use crate::simulation::machine::Usages;

/// Measures the simulations of an owner. `roots` has their root processes by port, which are the keys of the result.
/// Blocks for two seconds, which `docker stats` takes.
pub fn measure(owner: &ResourceOwner, roots: &BTreeMap<u16, i32>) -> Usages {
    let format = "{{.Name}}\t{{.CPUPerc}}\t{{.MemUsage}}";
    // Without names of containers: the whole command would fail if one of them had just ended.
    let printed = docker_output(&["stats", "--no-stream", "--format", format], SHORT_TIMEOUT);
    let mut all = Usages::new();
    for (name, cpu, memory) in printed.unwrap_or_default().lines().filter_map(columns) {
        let Some(root) = owner.port_of(name).and_then(|port| roots.get(&port)) else {
            continue;
        };
        let sum = all.entry(*root).or_default();
        sum.cpu = Some(sum.cpu.unwrap_or_default() + cpu);
        sum.memory += memory;
    }
    all
}

/// The container, its CPU usage in percent and its memory in a line of `docker stats`.
fn columns(line: &str) -> Option<(&str, f64, u64)> {
    let (name, rest) = line.split_once('\t')?;
    let (cpu, memory) = rest.split_once('\t')?;
    Some((
        name,
        cpu.trim_end_matches('%').parse().ok()?,
        bytes(memory.split_once(" / ")?.0)?,
    ))
}

/// An amount such as `12.3MiB`.
fn bytes(amount: &str) -> Option<u64> {
    let (number, unit) = amount.split_at(amount.find(|letter: char| letter.is_ascii_alphabetic())?);
    let shift = ["B", "KiB", "MiB", "GiB", "TiB"]
        .iter()
        .position(|known| *known == unit)?;
    let bytes = number.parse::<f64>().ok()? * f64::from(1_u32 << 10).powi(i32::try_from(shift).ok()?);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "what a machine has fits"
    )]
    Some(bytes as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_docker_is_read() {
        assert_eq!(columns("ab\t12.50%\t12.3MiB / 4GiB"), Some(("ab", 12.5, 12_897_484)));
        for line in ["ab\t--\t-- / --", "", "ab\t1%\t12 / 13", "ab\t1%\t1parsec / 2GiB"] {
            assert_eq!(columns(line), None, "{line}");
        }
    }
}
