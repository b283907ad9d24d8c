//! What a session server was told of the simulations of this server, and what it must be told next. Part of its link.

use std::collections::{BTreeMap, HashSet};
use std::time::{Duration, Instant};

use crate::shared::domain::{RosterUpdate, SimulationReport};
use crate::simulation::machine::Usages;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::Simulation;

/// What was told.
#[derive(Debug, Default)]
pub(super) struct RosterFeed {
    /// Whether figures are told.
    pub(super) has_figures: bool,
    /// The last figures.
    pub(super) usages: Usages,
    /// How fast simulations ran at the last measurement, in percent.
    factors: BTreeMap<SimulationId, u32>,
    /// When the last measurement began.
    measured: Option<Instant>,
    /// The simulations as they were told; `None` before the first update.
    told: Option<BTreeMap<SimulationId, SimulationReport>>,
}

/// Most simulations in one message.
const PER_MESSAGE: usize = 50;
/// Interval between two measurements.
const FIGURES: Duration = Duration::from_secs(5);
/// Figures are told in steps of this many percent, so that small changes cost nothing.
const STEP: f64 = 5.0;

impl RosterFeed {
    /// Whether it is time to measure again.
    pub(super) fn is_due(&self) -> bool {
        self.has_figures && self.measured.is_none_or(|at| at.elapsed() >= FIGURES)
    }

    /// A measurement begins.
    pub(super) fn begin(&mut self) {
        self.measured = Some(Instant::now());
    }

    /// What has changed.
    pub(super) fn updates(&mut self, simulations: &[Simulation]) -> Vec<RosterUpdate> {
        if self.is_due() {
            let factor = |one: &Simulation| Some((one.id, in_steps(100.0 * one.time.recent()?)));
            self.factors = simulations.iter().filter_map(factor).collect();
        }
        let is_first = self.told.is_none();
        let mut told = self.told.take().unwrap_or_default();
        let there: HashSet<SimulationId> = simulations.iter().map(|one| one.id).collect();
        let ended = told.keys().filter(|id| !there.contains(id));
        let ended: Vec<String> = ended.map(ToString::to_string).collect();
        told.retain(|id, _| there.contains(id));
        let mut changed = Vec::new();
        for simulation in simulations {
            let usage = simulation.pid.and_then(|pid| self.usages.get(&pid)?.cpu).map(in_steps);
            let figures = (usage, self.factors.get(&simulation.id).copied());
            let report = report(simulation, if self.has_figures { figures } else { (None, None) });
            if told.get(&simulation.id) != Some(&report) {
                told.insert(simulation.id, report.clone());
                changed.push(report);
            }
        }
        self.told = Some(told);
        if !is_first && changed.is_empty() && ended.is_empty() {
            return Vec::new();
        }
        let mut parts = changed.chunks(PER_MESSAGE).map(<[SimulationReport]>::to_vec);
        let first = RosterUpdate {
            all: is_first,
            simulations: parts.next().unwrap_or_default(),
            ended,
        };
        let rest = parts.map(|simulations| RosterUpdate {
            simulations,
            ..RosterUpdate::default()
        });
        std::iter::once(first).chain(rest).collect()
    }
}

/// `figures`: the percentages of a core and of real time.
fn report(simulation: &Simulation, (cpu, real_time): (Option<u32>, Option<u32>)) -> SimulationReport {
    SimulationReport {
        id: simulation.id.to_string(),
        world: simulation.world.clone(),
        user: simulation.identity.user.clone(),
        label: simulation.identity.label.clone(),
        state: simulation.stage,
        since: simulation.since,
        waited: simulation.waited.map(|seconds| (seconds * 10.0).round() / 10.0),
        away_until: simulation.away_until,
        cpu,
        real_time,
    }
}

/// A percentage, rounded to whole steps.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "it is cut to the range before"
)]
fn in_steps(percent: f64) -> u32 {
    ((percent / STEP).round() * STEP).clamp(0.0, 1_000_000.0) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::{ProjectUrl, Stage};
    use crate::simulation::client_identity::ClientIdentity;

    #[test]
    fn what_has_not_changed_is_not_told_again() {
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap();
        let simulation = || Simulation::new(SimulationId::next(), &world, ClientIdentity::default());
        let mut all: Vec<Simulation> = std::iter::repeat_with(simulation).take(120).collect();
        let mut feed = RosterFeed::default();
        let first = feed.updates(&all);
        let counts: Vec<_> = first.iter().map(|one| (one.all, one.simulations.len())).collect();
        assert_eq!(counts, [(true, 50), (false, 50), (false, 20)]);
        assert_eq!(feed.updates(&all), []);
        all[7].stage = Stage::Running;
        let ended = all.pop().unwrap().id.to_string();
        let next = feed.updates(&all);
        assert_eq!(next.len(), 1);
        assert_eq!(next[0].simulations[0].id, all[7].id.to_string());
        assert_eq!(
            (next[0].all, next[0].simulations.len(), &next[0].ended),
            (false, 1, &vec![ended])
        );
        assert_eq!(RosterFeed::default().updates(&[]).len(), 1, "an empty server says so");
    }

    #[test]
    fn figures_are_told_in_steps() {
        for (percent, told) in [(0.0, 0), (2.4, 0), (2.6, 5), (98.0, 100), (1e12, 1_000_000), (-1.0, 0)] {
            assert_eq!(in_steps(percent), told, "{percent}");
        }
    }
}
