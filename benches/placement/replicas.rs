//! Several session servers in front of one fleet: each sees all reports and only its own placements.

use super::compare::{mean, scenarios};
use super::dispatch::{Dispatcher, Own, Seen};
use super::scenario::{Arrivals, Outcome, Scenario, Sizes};
use super::world::run;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

/// Among which servers a session server chooses the least loaded one.
#[derive(Debug, Clone, Copy)]
enum Among {
    /// Among all: what the project does.
    All,
    /// Among two random ones if one has room, so that session servers with the same reports choose different ones.
    Two,
}

/// Several session servers with the project's own policy; each client asks a random one.
struct Replicas {
    policies: Vec<Own>,
    servers: usize,
    among: Among,
    random: StdRng,
}

impl Dispatcher for Replicas {
    fn report(&mut self, server: usize, now: f64, seen: Seen) {
        self.policies
            .iter_mut()
            .for_each(|replica| replica.report(server, now, seen));
    }

    fn place(&mut self, now: f64) -> Option<usize> {
        let any = self.random.random_range(0..self.policies.len());
        let replica = &mut self.policies[any];
        let of_two = match self.among {
            Among::All => None,
            Among::Two => {
                let two = [(); 2].map(|()| self.random.random_range(0..self.servers));
                replica.place_among(now, |server| two.contains(server))
            }
        };
        of_two.or_else(|| replica.place(now))
    }
}

fn outcome(scenario: &Scenario, count: usize, among: Among) -> Outcome {
    mean(scenario, |seed| {
        let policies = (0..count).map(|_| Own::new(scenario.servers, true)).collect();
        let random = StdRng::seed_from_u64(seed);
        run(
            scenario,
            seed,
            &mut Replicas {
                policies,
                servers: scenario.servers,
                among,
                random,
            },
        )
    })
}

/// Prints the outcomes for these fleets at these refresh intervals with 1, 2, 4 and 8 session servers.
pub(crate) fn measure(fleets: &[usize], refreshes: &[f64]) {
    println!("\nWorst highest load, and mean shares of overload and refusal, in %, by the number of session servers:");
    table("the least loaded of all servers", Among::All, fleets, refreshes);
    table("the lesser loaded of any two servers", Among::Two, fleets, refreshes);
}

fn table(title: &str, among: Among, fleets: &[usize], refreshes: &[f64]) {
    println!("\nEach chooses {title}:\n");
    println!("| servers | arrivals | machines | 1 | 2 | 4 | 8 |\n|---|---|---|---|---|---|---|");
    for &servers in fleets {
        for arrivals in Arrivals::ALL {
            for sizes in [Sizes::Equal, Sizes::Mixed] {
                let mut chosen = scenarios(&[servers], refreshes);
                chosen.retain(|scenario| scenario.arrivals == arrivals && scenario.sizes == sizes);
                let cells = [1, 2, 4, 8].map(|count| cell(&chosen, count, among));
                println!("| {servers} | {arrivals:?} | {sizes:?} | {} |", cells.join(" | "));
            }
        }
    }
}

fn cell(scenarios: &[Scenario], count: usize, among: Among) -> String {
    let all: Vec<Outcome> = scenarios
        .iter()
        .map(|scenario| outcome(scenario, count, among))
        .collect();
    let highest = all.iter().map(|one| one.highest).fold(0.0, f64::max);
    let share = |of: fn(&Outcome) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
    format!(
        "{highest:.0} / {:.2} / {:.1}",
        share(|one| one.overload),
        share(|one| one.refused)
    )
}
