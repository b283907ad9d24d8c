//! Compares the placement policy with others in a simulated fleet.
//!
//! `cargo bench --bench placement` runs all scenarios, prints their outcomes, and fails if a rival is better anywhere;
//! `-- --quick` runs a few in a second or two.

#![expect(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss,
    clippy::float_cmp,
    clippy::indexing_slicing,
    reason = "a simulation counts in small numbers, compares times with themselves, and may end at once if it is wrong"
)]

mod compare;
mod dispatch;
mod replicas;
mod scenario;
mod world;

use compare::{
    HIGHEST_TIE, OVERLOAD_TIE, POLICIES, REFUSED_TIE, Row, better_rivals, compare, foreign_scenarios, hole_scenarios,
    scenarios, share_that_fails,
};
use scenario::{Arrivals, Outcome, Scenario, Sizes};
use std::hint::black_box;
use std::process::ExitCode;
use std::time::{Duration, Instant};
use webots_fleet::session::placement::{LoadBalancer, PlacementPolicy};
use webots_fleet::shared::domain::{Instances, Load, ServerReport};

/// Seconds after which the starts of a black hole fail.
const HOLES: [f64; 2] = [0.5, 40.0];

fn main() -> ExitCode {
    let begin = Instant::now();
    // `cargo test --all-targets` runs this program too, without the argument that `cargo bench` adds.
    let quick = std::env::args().any(|argument| argument == "--quick")
        || !std::env::args().any(|argument| argument == "--bench");
    let (plain, foreign) = if quick {
        (scenarios(&[5], &[1.0, 10.0]), foreign_scenarios(&[5]))
    } else {
        (
            scenarios(&[5, 50, 500], &[0.1, 1.0, 3.0, 10.0]),
            foreign_scenarios(&[5, 50]),
        )
    };
    println!(
        "Each cell: highest load that clients asked of a server (%), share of the servers' time over 100 % (%), refused clients (%).\n"
    );
    println!(
        "{:42}{}",
        "servers, sizes, arrivals, sessions, refresh",
        POLICIES.map(|name| format!(" | {name:>16}")).concat()
    );
    let lost = measure(&plain);
    println!("\nThe same where other programs use the machines too, which does not decide whether this fails:\n");
    measure(&foreign);
    replicas::measure(
        if quick { &[5] } else { &[5, 50] },
        if quick { &[1.0] } else { &[1.0, 3.0] },
    );
    for fails_after in HOLES {
        black_hole(if quick { &[5] } else { &[5, 50] }, fails_after);
    }
    speed();
    println!(
        "\n{} scenarios in {:.0} s",
        plain.len() + foreign.len(),
        begin.elapsed().as_secs_f64()
    );
    if lost == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

/// Runs scenarios and prints their outcomes; returns the number of those in which a rival must not be better, but is.
fn measure(scenarios: &[Scenario]) -> usize {
    let rows = compare_all(scenarios);
    for (scenario, row) in scenarios.iter().zip(&rows) {
        let Scenario {
            arrivals,
            refresh,
            servers,
            sizes,
            sessions,
            ..
        } = scenario;
        let name = format!("{servers:>3} {sizes:?} {arrivals:?} {sessions:?} {refresh} s");
        println!(
            "{name:42}{}",
            row.map(|cell| format!(" | {:6.0} {:5.2} {:4.1}", cell.highest, cell.overload, cell.refused))
                .concat()
        );
    }
    summary(scenarios, &rows);
    verdict(scenarios, &rows)
}

/// Prints which share of the clients fails if one server is a black hole.
fn black_hole(fleets: &[usize], fails_after: f64) {
    println!("\nOne server fails each start after {fails_after} s. Clients whose starts fail, in %:\n");
    println!("| servers | arrivals | with ejection | without |\n|---|---|---|---|");
    for scenario in hole_scenarios(fleets, fails_after) {
        let [with, without] = share_that_fails(&scenario);
        println!(
            "| {} | {:?} | {with:.1} | {without:.1} |",
            scenario.servers, scenario.arrivals
        );
    }
}

/// Spreads the scenarios over the cores, which does not change their outcomes.
fn compare_all(scenarios: &[Scenario]) -> Vec<Row> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let mut rows = vec![Row::default(); scenarios.len()];
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|first| {
                scope.spawn(move || {
                    let mine = scenarios.iter().enumerate().skip(first).step_by(threads);
                    mine.map(|(i, scenario)| (i, compare(scenario))).collect::<Vec<_>>()
                })
            })
            .collect();
        for worker in workers {
            for (i, row) in worker.join().into_iter().flatten() {
                rows[i] = row;
            }
        }
    });
    rows
}

/// The table of the documentation: worst highest load and mean shares, for each kind of arrivals, sizes and refresh.
fn summary(scenarios: &[Scenario], rows: &[Row]) {
    println!("\nWorst highest load, and mean shares of overload and refusal, in %:\n");
    println!("| arrivals | machines | {} |", POLICIES.join(" | "));
    println!("|---|---|{}", "---|".repeat(POLICIES.len()));
    for arrivals in Arrivals::ALL {
        for sizes in [Sizes::Equal, Sizes::Mixed] {
            let chosen = select(scenarios, rows, |scenario| {
                scenario.arrivals == arrivals && scenario.sizes == sizes
            });
            println!("| {arrivals:?} | {sizes:?} | {} |", cells(&chosen));
        }
    }
    println!(
        "\n| refresh | {} |\n|---|{}",
        POLICIES.join(" | "),
        "---|".repeat(POLICIES.len())
    );
    for refresh in [0.1, 1.0, 3.0, 10.0] {
        let chosen = select(scenarios, rows, |scenario| scenario.refresh == refresh);
        if !chosen.is_empty() {
            println!("| {refresh} s | {} |", cells(&chosen));
        }
    }
}

fn select<'a>(scenarios: &[Scenario], rows: &'a [Row], wanted: impl Fn(&Scenario) -> bool) -> Vec<&'a Row> {
    scenarios
        .iter()
        .zip(rows)
        .filter(|(scenario, _)| wanted(scenario))
        .map(|(_, row)| row)
        .collect()
}

fn cells(rows: &[&Row]) -> String {
    let cell = |policy: usize| {
        let all = || rows.iter().map(|row| row[policy]);
        let worst = all().map(|outcome| outcome.highest).fold(0.0, f64::max);
        let mean = |part: fn(&Outcome) -> f64| all().map(|outcome| part(&outcome)).sum::<f64>() / rows.len() as f64;
        format!(
            "{worst:.0} / {:.2} / {:.1}",
            mean(|outcome| outcome.overload),
            mean(|outcome| outcome.refused)
        )
    };
    (0..POLICIES.len()).map(cell).collect::<Vec<_>>().join(" | ")
}

/// Measures how long one placement and one report take among 1,000 servers.
fn speed() {
    const SERVERS: u32 = 1000;
    const ROUNDS: u32 = 2000;
    let start = Instant::now();
    let mut fleet = LoadBalancer::new(PlacementPolicy::default());
    (0..SERVERS).for_each(|id| fleet.add(id));
    let report = |arrivals| ServerReport {
        load: Load::try_from(30.0).unwrap_or_default(),
        instances: Some(Instances {
            running: 10,
            slots: 100,
            arrivals,
            ..Instances::default()
        }),
        ..ServerReport::default()
    };
    (0..SERVERS).for_each(|id| fleet.report(&id, start, &report(10), true));
    let begin = Instant::now();
    for _ in 0..ROUNDS {
        black_box(fleet.pick(start, true, |_| true));
    }
    let place = begin.elapsed() / ROUNDS;
    let begin = Instant::now();
    for id in 0..SERVERS {
        fleet.report(&id, start + Duration::from_secs(1), &report(12), true);
    }
    println!(
        "\n1,000 servers: a placement takes {place:?}, a report {:?}",
        begin.elapsed() / SERVERS
    );
}

/// Prints where rivals are better, and returns the number of scenarios in which they must not be, but are: of all
/// scenarios if servers report their instances, of those with equal machines if they report only a load.
fn verdict(scenarios: &[Scenario], rows: &[Row]) -> usize {
    println!(
        "\nTied means within {HIGHEST_TIE} % of highest load, {OVERLOAD_TIE} % of overload share, {REFUSED_TIE} % of refusals."
    );
    let lost = |policy: usize, sizes: Sizes| {
        let all: Vec<_> = scenarios
            .iter()
            .zip(rows)
            .filter(|(scenario, _)| scenario.sizes == sizes)
            .collect();
        let mut lost = 0;
        for (scenario, row) in &all {
            let better = better_rivals(row, policy);
            if !better.is_empty() {
                println!("{:?}: {}", scenario, better.join("; "));
                lost += 1;
            }
        }
        let best = all.len() - lost;
        println!(
            "{}: best or tied in {best} of {} scenarios with {sizes:?} machines",
            POLICIES[policy],
            all.len()
        );
        lost
    };
    // One cost for machines that differ by a factor of eight is wrong for most of them.
    lost(1, Sizes::Mixed);
    lost(1, Sizes::Equal) + lost(0, Sizes::Mixed) + lost(0, Sizes::Equal)
}
