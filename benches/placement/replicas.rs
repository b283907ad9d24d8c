//! Several session servers in front of one fleet: each sees all reports and only its own placements.

use super::compare::{mean, scenarios};
use super::dispatch::{Dispatcher, Own, Seen};
use super::scenario::{Arrivals, Outcome, Scenario, Sizes};
use super::world::run;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

/// So many of the project's own policies; each client asks any one of them.
struct Replicas {
    replicas: Vec<Own>,
    random: StdRng,
}

impl Dispatcher for Replicas {
    fn report(&mut self, server: usize, now: f64, seen: Seen) {
        self.replicas.iter_mut().for_each(|replica| replica.report(server, now, seen));
    }

    fn place(&mut self, now: f64) -> Option<usize> {
        let any = self.random.random_range(0..self.replicas.len());
        self.replicas[any].place(now)
    }
}

fn outcome(scenario: &Scenario, count: usize) -> Outcome {
    mean(scenario, |seed| {
        let replicas = (0..count).map(|_| Own::new(scenario.servers, true)).collect();
        run(scenario, seed, &mut Replicas { replicas, random: StdRng::seed_from_u64(seed) })
    })
}

/// Prints what becomes of the scenarios of these fleets at these refresh intervals with 1, 2, 4 and 8 session servers.
pub(crate) fn measure(fleets: &[usize], refreshes: &[f64]) {
    println!(
        "\nWorst highest load, and mean shares of overload and refusal, in %, by the number of session servers:\n"
    );
    println!("| servers | arrivals | machines | 1 | 2 | 4 | 8 |\n|---|---|---|---|---|---|---|");
    for &servers in fleets {
        for arrivals in Arrivals::ALL {
            for sizes in [Sizes::Equal, Sizes::Mixed] {
                let mut chosen = scenarios(&[servers], refreshes);
                chosen.retain(|scenario| scenario.arrivals == arrivals && scenario.sizes == sizes);
                let cells = [1, 2, 4, 8].map(|count| {
                    let all: Vec<Outcome> = chosen.iter().map(|scenario| outcome(scenario, count)).collect();
                    let highest = all.iter().map(|one| one.highest).fold(0.0, f64::max);
                    let share = |of: fn(&Outcome) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
                    format!("{highest:.0} / {:.2} / {:.1}", share(|one| one.overload), share(|one| one.refused))
                });
                println!("| {servers} | {arrivals:?} | {sizes:?} | {} |", cells.join(" | "));
            }
        }
    }
}
