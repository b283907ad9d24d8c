//! Which GPU the next simulation gets, with `gpus: "spread"`.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use parking_lot::Mutex;

use super::sensors::Gpu;

/// Time in which a started simulation may not show in the readings of its GPU: Webots loads its world first.
const UNSEEN: Duration = Duration::from_secs(10);
/// Load that is added for each such simulation, in percent.
const EXPECTED: f64 = 10.0;

/// Spreads simulations over GPUs: the one with the least load gets the next. A simulation that was assigned to a GPU in
/// the last ten seconds counts as 10 % of load; of equal GPUs, the one that was chosen longest ago comes first.
#[derive(Debug, Default)]
pub struct Spread {
    /// Number of GPUs that have a display, the first ones; 0 if no simulation needs one.
    displays: usize,
    /// Times of assignments to each GPU: the last one, and those that readings may not show yet.
    given: Mutex<HashMap<u32, Vec<Instant>>>,
}

impl Spread {
    /// Spreads over the first `displays` GPUs; over all if it is 0.
    pub fn over(displays: usize) -> Self {
        Self {
            displays,
            ..Self::default()
        }
    }

    /// The GPU that the next simulation would get.
    pub fn next<'gpus>(&self, gpus: &'gpus [Gpu], now: Instant) -> Option<&'gpus Gpu> {
        self.choose(&self.given.lock(), gpus, now)
    }

    /// Assigns a simulation to one of the GPUs that answer; `None` if none does.
    pub fn take(&self, gpus: &[Gpu], now: Instant) -> Option<Gpu> {
        let mut given = self.given.lock();
        let chosen = self.choose(&given, gpus, now)?;
        let times = given.entry(chosen.index).or_default();
        times.retain(|at| is_unseen(*at, now));
        times.push(now);
        Some(chosen.clone())
    }

    fn choose<'gpus>(
        &self,
        given: &HashMap<u32, Vec<Instant>>,
        gpus: &'gpus [Gpu],
        now: Instant,
    ) -> Option<&'gpus Gpu> {
        let times = |gpu: &Gpu| given.get(&gpu.index).map(Vec::as_slice).unwrap_or_default();
        let expected = |gpu: &Gpu| {
            times(gpu)
                .iter()
                .filter(|at| is_unseen(**at, now))
                .map(|_| EXPECTED)
                .sum::<f64>()
        };
        let load = |gpu: &Gpu| gpu.load() + expected(gpu);
        let has_display = |gpu: &&Gpu| self.displays == 0 || (gpu.index as usize) < self.displays;
        let order = |one: &&Gpu, other: &&Gpu| {
            load(one)
                .total_cmp(&load(other))
                .then_with(|| times(one).last().cmp(&times(other).last()))
        };
        gpus.iter().filter(has_display).min_by(order)
    }
}

fn is_unseen(at: Instant, now: Instant) -> bool {
    now.saturating_duration_since(at) < UNSEEN
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gpus(loads: &[f64]) -> Vec<Gpu> {
        (0..)
            .zip(loads)
            .map(|(index, compute)| Gpu {
                index,
                compute: *compute,
                ..Gpu::default()
            })
            .collect()
    }

    /// The GPUs assigned to `count` simulations that start at once.
    fn taken(spread: &Spread, gpus: &[Gpu], count: usize, now: Instant) -> Vec<u32> {
        (0..count).map(|_| spread.take(gpus, now).unwrap().index).collect()
    }

    #[test]
    fn the_least_load_counts_and_starts_that_are_not_seen_yet() {
        let now = Instant::now();
        let spread = Spread::default();
        assert_eq!(spread.take(&[], now), None);
        assert_eq!(
            taken(&spread, &gpus(&[50.0, 30.0, 95.0, 30.0]), 6, now),
            [1, 3, 1, 3, 0, 1]
        );
        let later = now + UNSEEN;
        assert_eq!(spread.next(&gpus(&[50.0, 30.0, 20.0, 30.0]), later).unwrap().index, 2);
        let full = Gpu {
            memory: 90.0,
            ..Gpu::default()
        };
        assert_eq!(
            spread.next(&[full, gpus(&[0.0, 60.0]).remove(1)], later).unwrap().index,
            1
        );
    }

    #[test]
    fn equal_gpus_take_turns_however_slowly_simulations_start() {
        let mut now = Instant::now();
        let spread = Spread::default();
        let four = gpus(&[0.0; 4]);
        let mut counts = [0; 4];
        for index in taken(&spread, &four, 30, now) {
            counts[index as usize] += 1;
        }
        assert_eq!(counts, [8, 8, 7, 7]);
        let mut slowly = Vec::new();
        for _ in 0..4 {
            now += UNSEEN * 2;
            slowly.extend(taken(&spread, &four, 1, now));
        }
        slowly.sort_unstable();
        assert_eq!(slowly, [0, 1, 2, 3]);
    }
}
