//! The simulation server's HTML page.

use std::time::{Duration, SystemTime};

use askama::Template;
use url::Url;

use super::access::Visitor;
use crate::shared::domain::{Instances, ReadyStatus, Stage, View};
use crate::shared::http::{PageView, TableRow};
use crate::shared::run::timestamp;
use crate::shared::text::one_line;
use crate::simulation::ends::Ended;
use crate::simulation::machine::{Readings, Usage, Usages};
use crate::simulation::snapshot::{Simulation, Snapshot};
use crate::simulation::state::AppState;

/// The whole page `/monitor`.
#[derive(Template)]
#[template(path = "simulation/monitor.html")]
struct Monitor<'server> {
    server: &'server AppState,
    readings: &'server Readings,
    visitor: Visitor,
    view: &'server PageView,
}

/// The summary of the server.
#[derive(Template)]
#[template(path = "simulation/glance.html")]
struct Glance<'server> {
    server: &'server AppState,
    readings: &'server Readings,
    instances: Instances,
    load: f64,
    /// Why no simulation can be started; `None` if some can.
    problem: Option<String>,
    /// What is kept ready for clients.
    ready: Vec<ReadyStatus>,
}

/// The cells of one simulation.
#[derive(Template)]
#[template(path = "simulation/row.html")]
struct SimulationRow<'a> {
    visitor: Visitor,
    shows_port: bool,
    simulation: &'a Simulation,
    usage: Usage,
    /// When its time limit ends, in seconds since 1970; 0 if it is not launched.
    ends: u64,
}

/// The cells of one simulation that has ended.
#[derive(Template)]
#[template(path = "simulation/end.html")]
struct EndRow<'a> {
    visitor: Visitor,
    record: &'a Ended,
    simulation: &'a Simulation,
}

/// The parts of `/monitor` that change.
///
/// # Errors
/// When a template can't be rendered.
pub fn view(
    server: &AppState,
    snapshot: &Snapshot,
    usages: &Usages,
    visitor: Visitor,
) -> Result<PageView, askama::Error> {
    let readings = server.readings.borrow().clone();
    let shows_port = visitor.sees_ports(&server.config);
    let rows = snapshot.simulations.iter().map(|simulation| {
        let usage = simulation
            .pid
            .and_then(|pid| usages.get(&pid))
            .copied()
            .unwrap_or_default();
        let ends = simulation
            .launched
            .map_or(0, |launched| launched + server.config.timeout);
        let html = SimulationRow {
            visitor,
            shows_port,
            simulation,
            usage,
            ends,
        }
        .render()?;
        Ok(TableRow {
            key: simulation.id.to_string(),
            html,
        })
    });
    let rows = rows.collect::<Result<Vec<TableRow>, askama::Error>>()?;
    let ends = server.ends.latest();
    let ends = ends.iter().map(|record| {
        let html = EndRow {
            visitor,
            record,
            simulation: &record.simulation,
        }
        .render()?;
        Ok(TableRow {
            key: record.simulation.id.to_string(),
            html,
        })
    });
    let ends = ends.collect::<Result<Vec<TableRow>, askama::Error>>()?;
    let instances = snapshot.instances;
    let load = server.load().percent();
    let problem = server.problem();
    let glance = Glance {
        server,
        readings: &readings,
        instances,
        load,
        problem,
        ready: server.ready(),
    }
    .render()?;
    let parts = [("glance", glance)].into();
    let tables = [("simulations", rows), ("ends", ends)].into();
    Ok(PageView {
        parts,
        tables,
        sample: readings.sample(),
    })
}

/// The whole of `/monitor`, with these parts.
///
/// # Errors
/// When a template can't be rendered.
pub fn monitor(server: &AppState, view: &PageView, visitor: Visitor) -> Result<String, askama::Error> {
    Monitor {
        server,
        readings: &server.readings.borrow().clone(),
        visitor,
        view,
    }
    .render()
}

impl Monitor<'_> {
    fn started(&self) -> String {
        timestamp(SystemTime::now() - self.server.started.elapsed())
    }

    /// What worlds' programs can do because isolation is incomplete, and why it is.
    fn shortcoming(&self) -> Option<(&'static str, &str)> {
        let launcher = &self.server.launcher;
        let containers = self.server.containers.as_ref();
        let of_level = launcher
            .shortcoming()
            .map(|why| ("worlds' programs may do whatever this server may.", why));
        let of_containers = containers.and_then(|containers| containers.shortcoming.as_deref());
        of_level.or_else(|| of_containers.map(|why| ("", why)))
    }
}

/// A factor as a percentage, for sorting; -1 if it is not known.
fn percent(factor: Option<f64>) -> String {
    factor.map_or("-1".to_owned(), |factor| format!("{:.0}", 100.0 * factor))
}

fn time(seconds_since_1970: u64) -> String {
    timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds_since_1970))
}

/// The URL of a simulation's world as a link, with invisible and text-reversing characters escaped.
pub fn link(simulation: &Simulation) -> String {
    Url::parse(&simulation.world).map_or_else(|_| one_line(&simulation.world), String::from)
}

/// The repository of a simulation's world, without its scheme.
pub fn repository(simulation: &Simulation) -> String {
    one_line(simulation.repository.trim_start_matches("https://"))
}

/// The name of a world's file.
pub fn world(simulation: &Simulation) -> String {
    one_line(simulation.world.rsplit('/').next().unwrap_or_default())
}

/// A stage as text, and the CSS class of its color.
fn words(stage: Stage) -> (&'static str, &'static str) {
    match stage {
        Stage::Queued => ("waiting", "queued"),
        Stage::CheckingOut => ("checking out", "checkingout"),
        Stage::Launching => ("launching", "launching"),
        Stage::Idle => ("idle", "idle"),
        Stage::Running => ("running", "running"),
        Stage::Stopping => ("stopping", "stopping"),
    }
}

#[expect(clippy::cast_precision_loss, reason = "few digits are shown")]
fn bytes(count: u64) -> String {
    let mebibytes = count as f64 / 2_f64.powi(20);
    if mebibytes < 1024.0 {
        format!("{mebibytes:.0} MiB")
    } else {
        format!("{:.1} GiB", mebibytes / 1024.0)
    }
}

/// A duration as text in hours and minutes; the page's script adds the seconds.
fn duration(seconds: u64) -> String {
    match (seconds / 3600, seconds / 60 % 60) {
        (0, minutes) => format!("{minutes} min"),
        (hours, 0) => format!("{hours} h"),
        (hours, minutes) => format!("{hours} h {minutes:02} min"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::ProjectUrl;
    use crate::simulation::client_identity::ClientIdentity;
    use crate::simulation::simulation_id::SimulationId;

    #[test]
    fn sizes_and_times_are_short() {
        let sizes = [
            (0, "0 MiB"),
            (5 << 20, "5 MiB"),
            (3 << 30, "3.0 GiB"),
            (2500 << 30, "2500.0 GiB"),
        ];
        for (count, text) in sizes {
            assert_eq!(bytes(count), text);
        }
        for (seconds, text) in [(0, "0 min"), (360, "6 min"), (7200, "2 h"), (7260, "2 h 01 min")] {
            assert_eq!(duration(seconds), text);
        }
    }

    #[test]
    fn what_a_client_names_is_only_text() {
        let world = ProjectUrl::parse("https://github.com/u/<i>\"'&/blob/main/worlds/<script>.wbt").unwrap();
        let identity = ClientIdentity::new(Some("<i>root</i>".to_owned()), Some("<script>'\"&"));
        let simulation = Simulation::new(SimulationId::next(), &world, identity);
        for (visitor, has_names) in [
            (Visitor::Anybody, false),
            (Visitor::Stranger, false),
            (Visitor::Administrator, true),
        ] {
            let html = SimulationRow {
                visitor,
                shows_port: true,
                simulation: &simulation,
                usage: Usage::default(),
                ends: 0,
            }
            .render()
            .unwrap();
            assert!(!html.contains("<script>") && !html.contains("<i>"), "{html}");
            assert_eq!(html.contains("root"), has_names, "{html}");
        }
    }
}
