//! The result of a rehearsal, in numbers.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use crate::arguments::Arguments;
use crate::line::Line;
use crate::real_time_factors::{RealTimeFactors, factors, factors_of, quantile, sorted};
use crate::visit::{Outcome, Steps, Visit};

/// The numbers of a rehearsal.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Report {
    /// The fleet's URL, as on the command line.
    pub(crate) fleet: String,
    /// The URL of the world that was started.
    pub(crate) world: String,
    /// A summary of what was played.
    pub(crate) played: String,
    /// The seats of all clients.
    pub(crate) seats: Seats,
    /// The time until a simulation ran, in seconds.
    pub(crate) times: Vec<Row>,
    /// How fair it was to those who waited. `None` if nobody did.
    pub(crate) line: Option<Line>,
    /// The speed of simulated time; 1 is real time. `None` if no simulation ran for long enough.
    pub(crate) pace: Option<RealTimeFactors>,
    /// Each simulation server.
    pub(crate) servers: Vec<Server>,
    /// The result in one sentence.
    pub(crate) verdict: String,
    /// Number of clients that had to fit.
    pub(crate) expected: Option<u32>,
    /// Whether it was interrupted, so that only a part was played.
    pub(crate) interrupted: bool,
}

/// The requested seats, and their outcomes.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Seats {
    /// Simulations that were requested.
    pub(crate) asked: u32,
    /// Simulations that ran.
    pub(crate) given: u32,
    /// Those of them that ran to their client's end, at least at the requested share of real time.
    pub(crate) fit: u32,
    /// Clients that were refused or got none, by the reason and the simulation server that it came from.
    pub(crate) refused: BTreeMap<String, u32>,
    /// Simulations that ended before their client left, by the reason and the simulation server.
    pub(crate) broke_off: BTreeMap<String, u32>,
    /// Simulations that ran and whose end was not observed: their client slept, vanished, or was interrupted.
    pub(crate) unseen: u32,
    /// Simulations that ran to their client's end, but too briefly to measure their pace.
    pub(crate) unmeasured: u32,
    /// Clients that left before their simulation ran.
    pub(crate) left: u32,
}

/// One step to a running simulation, over all clients, in seconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Row {
    /// The step.
    pub(crate) step: &'static str,
    /// The median.
    pub(crate) median: f64,
    /// The 95th percentile.
    pub(crate) p95: f64,
    /// The maximum.
    pub(crate) worst: f64,
}

/// One simulation server.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Server {
    /// `HOST:PORT` or `HOST/PORT`.
    pub(crate) address: String,
    /// Simulations that ran there.
    pub(crate) seats: u32,
    /// The largest number that ran at the same time.
    pub(crate) most_at_once: u32,
    /// The highest load that it reported, in percent.
    pub(crate) peak_load: Option<f64>,
    /// The speed of simulated time there.
    pub(crate) pace: Option<RealTimeFactors>,
}

/// The JSON file: the numbers, and each client's visit.
#[derive(Serialize)]
struct File<'report> {
    #[serde(flatten)]
    report: &'report Report,
    visits: Vec<OneVisit<'report>>,
}

/// A visit, and the speed of simulated time in it.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct OneVisit<'report> {
    #[serde(flatten)]
    visit: &'report Visit,
    real_time: Option<RealTimeFactors>,
}

impl Report {
    /// Computes the numbers from the clients' visits and the highest load of each server.
    pub(crate) fn new(arguments: &Arguments, visits: &[Visit], peaks: &BTreeMap<String, Option<f64>>) -> Self {
        let seats = seats(visits, arguments.real_time);
        let servers: Vec<Server> = peaks
            .iter()
            .map(|(address, peak)| {
                let here: Vec<&Visit> = visits
                    .iter()
                    .filter(|visit| visit.server.as_ref() == Some(address) && visit.has_run())
                    .collect();
                server(address, *peak, &here)
            })
            .collect();
        Self {
            fleet: arguments.fleet.to_string(),
            world: arguments.world.clone(),
            played: arguments.summary(),
            times: times(visits),
            line: Line::of(visits),
            pace: factors(visits.iter().flat_map(factors_of)),
            verdict: verdict(&seats),
            expected: arguments.expect,
            interrupted: false,
            seats,
            servers,
        }
    }

    /// Records that only a part of it was played.
    pub(crate) fn interrupt(&mut self) {
        self.interrupted = true;
        self.played += ", interrupted";
    }

    /// Whether as many fit as expected; without `--expect`, whether any did.
    pub(crate) fn is_as_expected(&self) -> bool {
        self.seats.fit >= self.expected.unwrap_or(1)
    }

    /// Writes the numbers and all visits as JSON.
    ///
    /// # Errors
    /// When the file can't be written.
    pub(crate) fn write(&self, visits: &[Visit], file: &Path) -> std::io::Result<()> {
        let visits = visits
            .iter()
            .map(|visit| OneVisit {
                visit,
                real_time: factors(factors_of(visit)),
            })
            .collect();
        let text = serde_json::to_string_pretty(&File { report: self, visits })?;
        std::fs::write(file, text + "\n")
    }
}

fn seats(visits: &[Visit], real_time: f64) -> Seats {
    let mut seats = Seats::default();
    for visit in visits {
        seats.asked += 1;
        seats.given += u32::from(visit.has_run());
        match &visit.outcome {
            Outcome::Ran => match factors(factors_of(visit)) {
                Some(pace) => seats.fit += u32::from(pace.median >= real_time),
                // If any pace is allowed, it need not be known.
                None if real_time > 0.0 => seats.unmeasured += 1,
                None => seats.fit += 1,
            },
            Outcome::Refused(why) | Outcome::Failed(why) => *seats.refused.entry(reason(why, visit)).or_default() += 1,
            Outcome::BrokeOff(why) => *seats.broke_off.entry(reason(why, visit)).or_default() += 1,
            Outcome::Unseen => seats.unseen += 1,
            Outcome::Left => seats.left += 1,
        }
    }
    seats
}

/// The reason that a client received, without its simulation's output, and with the simulation server unless the reason
/// already names it.
fn reason(why: &str, visit: &Visit) -> String {
    let why = why
        .split(" Its last output:")
        .next()
        .unwrap_or(why)
        .trim_end_matches('.');
    let server = visit.server.as_deref().filter(|server| !why.contains(server));
    server.map_or(why.to_owned(), |server| format!("{why} at {server}"))
}

fn times(visits: &[Visit]) -> Vec<Row> {
    type Pick = fn(&Steps) -> Option<f64>;
    let steps: [(&'static str, Pick); 4] = [
        ("waiting", |steps| steps.waiting),
        ("checkout", |steps| steps.checkout),
        ("launch", |steps| steps.launch),
        ("all", |steps| steps.until_running),
    ];
    let row = |(step, pick): (&'static str, Pick)| {
        let times = sorted(
            visits
                .iter()
                .filter(|visit| visit.has_run())
                .filter_map(|visit| pick(&visit.steps)),
        );
        let at = |share| quantile(&times, share);
        Some(Row {
            step,
            median: at(0.5)?,
            p95: at(0.95)?,
            worst: *times.last()?,
        })
    };
    steps.into_iter().filter_map(row).collect()
}

fn server(address: &str, peak_load: Option<f64>, here: &[&Visit]) -> Server {
    Server {
        address: address.to_owned(),
        seats: u32::try_from(here.len()).unwrap_or(u32::MAX),
        most_at_once: most_at_once(here),
        peak_load,
        pace: factors(here.iter().flat_map(|visit| factors_of(visit))),
    }
}

/// When a visit's simulation began to run, in seconds since the start.
fn began(visit: &Visit) -> f64 {
    visit.asked + visit.steps.until_running.unwrap_or_default()
}

fn most_at_once(here: &[&Visit]) -> u32 {
    let mut changes: Vec<(f64, i32)> = here
        .iter()
        .flat_map(|visit| [(began(visit), 1), (visit.ended, -1)])
        .collect();
    changes.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1)));
    let mut now = 0_i32;
    let most = changes.into_iter().map(|(_, change)| {
        now += change;
        now
    });
    most.max().and_then(|most| u32::try_from(most).ok()).unwrap_or_default()
}

fn verdict(seats: &Seats) -> String {
    let all = seats.asked - seats.left - seats.unseen - seats.unmeasured;
    let mut sentence = match (seats.fit, all) {
        (_, 0) if seats.unmeasured > 0 => "None stayed long enough to tell its pace".to_owned(),
        (_, 0) => "None was seen to its end".to_owned(),
        (0, _) => "None fits".to_owned(),
        (fit, all) if fit == all => format!("All {all} fit"),
        (fit, all) => format!("{fit} of {all} fit"),
    };
    let reasons = [("got none", &seats.refused), ("broke off", &seats.broke_off)];
    let reasons = reasons
        .into_iter()
        .flat_map(|(what, all)| all.iter().map(move |(why, number)| (number, what, why)));
    if let Some((number, what, why)) = reasons.max_by_key(|(number, ..)| **number) {
        sentence = format!("{sentence}; {number} {what}: {why}");
    }
    sentence + "."
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::behaviour::Behaviour;
    use crate::visit::Pace;
    use clap::Parser;

    fn visit(client: u32, server: &str, asked: f64, outcome: Outcome, factors: &[f64]) -> Visit {
        let ran = matches!(outcome, Outcome::Ran | Outcome::BrokeOff(_) | Outcome::Unseen).then_some(1.0);
        let pace = (0_u32..).zip(factors).map(|(second, factor)| Pace {
            at: asked + 3.0 + f64::from(second),
            factor: *factor,
        });
        let steps = Steps {
            waiting: ran,
            checkout: ran,
            launch: ran,
            until_running: ran.map(|step| 3.0 * step),
        };
        let server = Some(server.to_owned());
        Visit {
            client,
            behaviour: Behaviour::Ordinary,
            asked,
            server,
            place: None,
            turn: ran.map(|step| asked + step),
            outcome,
            steps,
            pace: pace.collect(),
            ended: asked + 10.0,
        }
    }

    fn report(more: &[&str], visits: &[Visit]) -> Report {
        let fixed = [
            "rehearse",
            "http://localhost:1999",
            "--world",
            "https://github.com/a/b/blob/m/worlds/w.wbt",
        ];
        let arguments = Arguments::parse_from(fixed.iter().chain(more));
        let peaks = BTreeMap::from([
            ("gpu-1:2000".to_owned(), Some(60.0)),
            ("gpu-2:2000".to_owned(), Some(99.0)),
        ]);
        Report::new(&arguments, visits, &peaks)
    }

    #[test]
    fn who_ran_to_the_end_in_real_time_fits() {
        let full = Outcome::Refused("Error: full.".to_owned());
        let visits = [
            visit(0, "gpu-1:2000", 0.0, Outcome::Ran, &[0.1, 1.0, 1.0]),
            visit(1, "gpu-1:2000", 1.0, Outcome::Ran, &[1.0, 1.0]),
            visit(2, "gpu-2:2000", 2.0, Outcome::Ran, &[1.0, 0.5, 0.5]),
            visit(
                3,
                "gpu-2:2000",
                3.0,
                Outcome::BrokeOff("Webots was killed".to_owned()),
                &[1.0, 1.0],
            ),
            visit(4, "gpu-2:2000", 4.0, full.clone(), &[]),
            visit(5, "gpu-2:2000", 5.0, full, &[]),
            visit(6, "gpu-2:2000", 6.0, Outcome::Left, &[]),
            visit(7, "gpu-1:2000", 20.0, Outcome::Unseen, &[1.0, 1.0]),
            visit(8, "gpu-1:2000", 40.0, Outcome::Ran, &[1.0]),
        ];
        let of_two = report(&["--expect", "2"], &visits);
        let seats = &of_two.seats;
        assert_eq!((seats.asked, seats.given, seats.fit), (9, 6, 2));
        assert_eq!((seats.unseen, seats.unmeasured, seats.left), (1, 1, 1));
        assert_eq!(
            seats.refused,
            BTreeMap::from([("Error: full at gpu-2:2000".to_owned(), 2)])
        );
        assert_eq!(seats.broke_off.values().sum::<u32>(), 1);
        assert!(of_two.is_as_expected() && !report(&["--expect", "3"], &visits).is_as_expected());
        assert_eq!(of_two.verdict, "2 of 6 fit; 2 got none: Error: full at gpu-2:2000.");
        let servers: Vec<_> = of_two
            .servers
            .iter()
            .map(|server| (server.seats, server.most_at_once, server.peak_load))
            .collect();
        assert_eq!(servers, [(4, 2, Some(60.0)), (2, 2, Some(99.0))]);
        assert!(report(&["--real-time", "0.4"], &visits).is_as_expected());
        let short = report(&[], &visits[8..]);
        assert_eq!(short.verdict, "None stayed long enough to tell its pace.");
        assert!(!short.is_as_expected() && report(&["--real-time", "0"], &visits[8..]).is_as_expected());
    }

    #[test]
    fn times_are_told_by_nearest_rank() {
        let visits: Vec<Visit> = (1_u32..=100)
            .map(|number| {
                let mut one = visit(number, "gpu-1:2000", 0.0, Outcome::Ran, &[1.0, 1.0]);
                one.steps.until_running = Some(f64::from(number));
                one
            })
            .collect();
        let all = report(&[], &visits);
        let row = all.times.last().unwrap();
        assert_eq!((row.step, row.median, row.p95, row.worst), ("all", 50.0, 95.0, 100.0));
        assert_eq!(all.verdict, "All 100 fit.");
        assert_eq!(all.pace, Some(RealTimeFactors { p5: 1.0, median: 1.0 }));
    }

    #[test]
    fn the_most_frequent_reason_is_told() {
        let full = Outcome::Refused("full".to_owned());
        let killed = Outcome::BrokeOff("Webots was killed.".to_owned());
        let all = |outcomes: &[&Outcome]| {
            let visits = (0..)
                .zip(outcomes)
                .map(|(client, one)| visit(client, "gpu-1:2000", 0.0, (*one).clone(), &[1.0; 2]));
            report(&[], &visits.collect::<Vec<_>>()).verdict
        };
        assert_eq!(
            all(&[&killed, &full, &killed]),
            "None fits; 2 broke off: Webots was killed at gpu-1:2000."
        );
        assert_eq!(
            all(&[&Outcome::Ran, &full, &full, &killed]),
            "1 of 4 fit; 2 got none: full at gpu-1:2000."
        );
    }
}
