//! The scenarios, and which policy wins in each.

use super::dispatch::{Own, Rival, Rule};
use super::scenario::{Arrivals, Foreign, Outcome, Scenario, Sessions, Sizes};
use super::world::run;

/// The policies in the order of a [`Row`]. The first one must win.
pub(crate) const POLICIES: [&str; 6] = [
    "ours",
    "ours, load only",
    "least reported",
    "random",
    "two choices",
    "round robin",
];
/// Index of the first rival in a row; those before it are the project's own policy.
pub(crate) const FIRST_RIVAL: usize = 2;
/// Highest loads that differ by no more than this are tied: two clients, in percent.
pub(crate) const HIGHEST_TIE: f64 = 4.0;
/// Overload shares that differ by no more than this are tied, in percent.
pub(crate) const OVERLOAD_TIE: f64 = 0.25;
/// Refused shares that differ by no more than this are tied, in percent.
pub(crate) const REFUSED_TIE: f64 = 1.0;

/// The outcome of each policy in a scenario, as means over the seeds.
pub(crate) type Row = [Outcome; POLICIES.len()];

/// All scenarios of fleets of these sizes at these refresh intervals.
pub(crate) fn scenarios(fleets: &[usize], refreshes: &[f64]) -> Vec<Scenario> {
    let mut all = Vec::new();
    for &servers in fleets {
        for sizes in [Sizes::Equal, Sizes::Mixed] {
            for arrivals in Arrivals::ALL {
                for sessions in [Sessions::Exponential, Sessions::Heavy] {
                    for &refresh in refreshes {
                        all.push(Scenario {
                            arrivals,
                            refresh,
                            servers,
                            sizes,
                            sessions,
                            foreign: Foreign::None,
                            fails_after: None,
                        });
                    }
                }
            }
        }
    }
    all
}

/// Scenarios in which other programs use the machines too.
pub(crate) fn foreign_scenarios(fleets: &[usize]) -> Vec<Scenario> {
    let mut all = scenarios(fleets, &[1.0]);
    all.retain(|scenario| scenario.sessions == Sessions::Exponential);
    for scenario in &mut all {
        scenario.foreign = Foreign::ComesAndGoes;
    }
    all
}

/// Scenarios in which one server is a black hole: each start fails there after so many seconds.
pub(crate) fn hole_scenarios(fleets: &[usize], fails_after: f64) -> Vec<Scenario> {
    let mut all = scenarios(fleets, &[1.0]);
    all.retain(|scenario| scenario.sessions == Sessions::Exponential && scenario.sizes == Sizes::Equal);
    for scenario in &mut all {
        scenario.fails_after = Some(fails_after);
    }
    all
}

/// The shares of clients whose starts fail in a black hole, in percent: with ejection and without it.
pub(crate) fn share_that_fails(scenario: &Scenario) -> [f64; 2] {
    let servers = scenario.servers;
    let with = mean(scenario, |seed| run(scenario, seed, &mut Own::new(servers, true)));
    let without = mean(scenario, |seed| {
        run(scenario, seed, &mut Own::without_ejection(servers))
    });
    [with.failed, without.failed]
}

/// The mean outcome of a scenario over its seeds; a small fleet depends more on chance and needs more seeds.
pub(crate) fn mean(scenario: &Scenario, run: impl Fn(u64) -> Outcome) -> Outcome {
    let seeds = match scenario.servers {
        ..50 => 20,
        50..500 => 4,
        _ => 1,
    };
    let mut mean = Outcome::default();
    for outcome in (1..=seeds).map(run) {
        mean.highest += outcome.highest / seeds as f64;
        mean.overload += outcome.overload / seeds as f64;
        mean.refused += outcome.refused / seeds as f64;
        mean.failed += outcome.failed / seeds as f64;
    }
    mean
}

/// Runs every policy on a scenario.
pub(crate) fn compare(scenario: &Scenario) -> Row {
    let servers = scenario.servers;
    let own = |instances| mean(scenario, |seed| run(scenario, seed, &mut Own::new(servers, instances)));
    let rival = |rule| {
        mean(scenario, |seed| {
            run(scenario, seed, &mut Rival::new(servers, rule, seed))
        })
    };
    [
        own(true),
        own(false),
        rival(Rule::LeastReported),
        rival(Rule::Random),
        rival(Rule::TwoChoices),
        rival(Rule::RoundRobin),
    ]
}

/// The rivals that are better than the policy at this index of the row, and in which respect.
///
/// A rival that loaded its servers less is not better if it refused more clients, and one that refused fewer clients is
/// not better if it loaded its servers more.
pub(crate) fn better_rivals(row: &Row, policy: usize) -> Vec<String> {
    let own = row[policy];
    let mut better = Vec::new();
    for (name, rival) in POLICIES.iter().zip(row).skip(FIRST_RIVAL) {
        let refuses_more = rival.refused > own.refused + REFUSED_TIE;
        let loads_more = rival.highest > own.highest + HIGHEST_TIE || rival.overload > own.overload + OVERLOAD_TIE;
        if own.highest > rival.highest + HIGHEST_TIE && !refuses_more {
            better.push(format!(
                "{name}: highest load {:.0} < {:.0}",
                rival.highest, own.highest
            ));
        }
        if own.overload > rival.overload + OVERLOAD_TIE && !refuses_more {
            better.push(format!("{name}: overload {:.2} < {:.2}", rival.overload, own.overload));
        }
        if own.refused > rival.refused + REFUSED_TIE && !loads_more {
            better.push(format!("{name}: refused {:.1} < {:.1}", rival.refused, own.refused));
        }
    }
    better
}
