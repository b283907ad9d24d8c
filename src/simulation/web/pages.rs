//! The simulation server's HTML page.

use std::time::{Duration, SystemTime};

use askama::Template;
use url::Url;

use super::administrator::Visitor;
use crate::shared::domain::Instances;
use crate::shared::http::{PageView, TableRow};
use crate::shared::run::{seconds_since_1970, timestamp};
use crate::shared::text::{one_line, without_paths};
use crate::simulation::ends::Ended;
use crate::simulation::machine::sensors::{self, Gpu, Machine};
use crate::simulation::machine::{Readings, Sample, Usage, Usages};
use crate::simulation::snapshot::{Simulation, Snapshot, Stage};
use crate::simulation::state::AppState;

/// The whole page `/monitor`.
#[derive(Template)]
#[template(path = "simulation/monitor.html")]
struct Monitor<'server> {
    server: &'server AppState,
    readings: &'server Readings,
    visitor: Visitor,
    version: &'static str,
    started: String,
    title: &'server str,
    glance: &'server str,
    /// The columns of the charts' numbers.
    columns: String,
    rows: &'server [TableRow],
    ends: &'server [TableRow],
    gpus: Vec<(&'server Gpu, String)>,
    memory: String,
    swap: String,
    shows_ports: bool,
    /// What worlds' programs may do that they should not, and why.
    shortcoming: Option<(&'static str, &'server str)>,
    limit: String,
}

/// The summary of the server.
#[derive(Template)]
#[template(path = "simulation/glance.html")]
struct Glance<'readings> {
    draining: bool,
    /// Why no simulation can be started; `None` if some can.
    problem: Option<String>,
    load: f64,
    busiest_part: &'static str,
    machine: Machine,
    memory: String,
    gpus: Vec<(&'readings Gpu, String)>,
    /// The problem with the GPUs, if there is one.
    gpu_problem: Option<&'readings str>,
    instances: Instances,
}

/// The cells of one simulation.
#[derive(Template)]
#[template(path = "simulation/row.html")]
struct SimulationRow<'one> {
    visitor: Visitor,
    one: &'one Simulation,
    link: String,
    world: String,
    repository: String,
    stage: &'static str,
    class: &'static str,
    since: String,
    /// When its time limit ends, in seconds since 1970; 0 if it is not launched.
    ends: u64,
    left: String,
    cpu: String,
    cpu_value: f64,
    memory: String,
    memory_value: u64,
    /// The port, if the visitor may see it.
    port: Option<u16>,
    can_be_watched: bool,
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
    let rows = snapshot.simulations.iter().map(|one| {
        let usage = one.pid.and_then(|pid| usages.get(&pid)).copied();
        let html = SimulationRow::new(one, usage, server.config.timeout, (visitor, shows_port)).render()?;
        Ok(TableRow { key: one.id.to_string(), html })
    });
    let rows = rows.collect::<Result<Vec<TableRow>, askama::Error>>()?;
    let ends = server.ends.latest();
    let ends = ends
        .iter()
        .map(|one| Ok(TableRow { key: one.simulation.id.to_string(), html: EndRow::new(one, visitor).render()? }));
    let ends = ends.collect::<Result<Vec<TableRow>, askama::Error>>()?;
    let glance = Glance::new(server, snapshot, &readings).render()?;
    let sample = readings.history.back().map(Sample::columns).unwrap_or_default();
    Ok(PageView { parts: [("glance", glance)].into(), tables: [("simulations", rows), ("ends", ends)].into(), sample })
}

/// The whole of `/monitor`.
///
/// # Errors
/// When a template can't be rendered.
pub fn monitor(
    server: &AppState,
    snapshot: &Snapshot,
    usages: &Usages,
    visitor: Visitor,
) -> Result<String, askama::Error> {
    let view = view(server, snapshot, usages, visitor)?;
    let readings = server.readings.borrow().clone();
    let table = |name| view.tables.get(name).map(Vec::as_slice).unwrap_or_default();
    let page = Monitor {
        server,
        readings: &readings,
        visitor,
        version: env!("CARGO_PKG_VERSION"),
        started: timestamp(SystemTime::now() - server.started.elapsed()),
        title: server.config.title.as_deref().unwrap_or("Webots simulation server"),
        glance: view.parts.get("glance").map(String::as_str).unwrap_or_default(),
        columns: Sample::headings(),
        rows: table("simulations"),
        ends: table("ends"),
        gpus: with_sizes(&readings.gpus),
        memory: bytes(readings.host.memory),
        swap: bytes(readings.host.swap),
        shows_ports: visitor.sees_ports(&server.config),
        shortcoming: shortcoming(server),
        limit: duration(server.config.timeout),
    };
    page.render()
}

/// The charts' numbers of the last ten minutes, the oldest first.
pub fn history(readings: &Readings) -> Vec<Vec<f64>> {
    let values = |sample: &Sample| sample.columns().iter().filter_map(|text| text.parse().ok()).collect();
    readings.history.iter().map(values).collect()
}

impl<'readings> Glance<'readings> {
    fn new(server: &AppState, snapshot: &Snapshot, readings: &'readings Readings) -> Self {
        Self {
            draining: server.is_draining(),
            problem: server.problem(),
            load: server.load().percent(),
            busiest_part: sensors::busiest(&readings.machine, readings.next_gpu.as_ref()),
            machine: readings.machine,
            memory: bytes(readings.host.memory),
            gpus: with_sizes(&readings.gpus),
            gpu_problem: readings.gpu_problem.as_deref(),
            instances: snapshot.instances,
        }
    }
}

/// Each GPU with the size of its memory as text.
fn with_sizes(gpus: &[Gpu]) -> Vec<(&Gpu, String)> {
    gpus.iter().map(|gpu| (gpu, bytes(gpu.memory_total))).collect()
}

/// The cells of one simulation that has ended.
#[derive(Template)]
#[template(path = "simulation/end.html")]
struct EndRow<'one> {
    visitor: Visitor,
    record: &'one Ended,
    one: &'one Simulation,
    link: String,
    world: String,
    repository: String,
    ended: String,
    after: String,
    why: String,
}

impl<'one> EndRow<'one> {
    fn new(record: &'one Ended, visitor: Visitor) -> Self {
        let one = &record.simulation;
        let (repository, world) = names(one);
        let (ended, after) = (text_of(record.at), duration(record.at.saturating_sub(one.since)));
        let (link, why) = (link(&one.world), without_paths(&record.how.why));
        Self { visitor, record, one, link, world, repository, ended, after, why }
    }
}

fn text_of(seconds_since_1970: u64) -> String {
    timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds_since_1970))
}

/// The URL of a world as a link, in which nothing is invisible or turns letters around.
pub fn link(url: &str) -> String {
    Url::parse(url).map_or_else(|_| one_line(url), String::from)
}

/// The repository of a world without its scheme, and the name of its file.
pub fn names(one: &Simulation) -> (String, String) {
    let file = one.world.rsplit('/').next().unwrap_or_default();
    (one_line(one.repository.trim_start_matches("https://")), one_line(file))
}

impl<'one> SimulationRow<'one> {
    fn new(one: &'one Simulation, usage: Option<Usage>, limit: u64, (visitor, shows_port): (Visitor, bool)) -> Self {
        let (stage, class) = words(one.stage);
        let ends = one.launched.map_or(0, |launched| launched + limit);
        let now = seconds_since_1970();
        let (repository, world) = names(one);
        Self {
            visitor,
            one,
            link: link(&one.world),
            world,
            repository,
            stage,
            class,
            since: text_of(one.since),
            ends,
            left: duration(ends.saturating_sub(now)),
            cpu: usage.and_then(|usage| usage.cpu).map(|cpu| format!("{cpu:.0} %")).unwrap_or_default(),
            cpu_value: usage.and_then(|usage| usage.cpu).unwrap_or(-1.0),
            memory: usage.map(|usage| bytes(usage.memory)).unwrap_or_default(),
            memory_value: usage.map_or(0, |usage| usage.memory),
            port: shows_port.then(|| one.port.unwrap_or_default()),
            can_be_watched: matches!(one.stage, Stage::Idle | Stage::Running),
        }
    }
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

#[expect(clippy::cast_precision_loss, reason = "three digits are shown")]
fn bytes(count: u64) -> String {
    let count = count as f64;
    let units = [("TiB", 2_f64.powi(40)), ("GiB", 2_f64.powi(30)), ("MiB", 2_f64.powi(20))];
    match units.iter().find(|(_, size)| count >= *size) {
        Some((unit, size)) => {
            let number = count / size;
            if number < 10.0 { format!("{number:.1} {unit}") } else { format!("{number:.0} {unit}") }
        }
        None if count > 0.0 => format!("{:.0} KiB", count / 1024.0),
        None => "none".to_owned(),
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

/// What worlds' programs can do because isolation is incomplete, and why it is.
fn shortcoming(server: &AppState) -> Option<(&'static str, &str)> {
    let of_level =
        server.launcher.shortcoming.as_deref().map(|why| ("worlds' programs may do whatever this server may.", why));
    let of_containers = server.containers.as_ref().and_then(|containers| containers.shortcoming.as_deref());
    of_level.or_else(|| of_containers.map(|why| ("", why)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::ProjectUrl;
    use crate::simulation::client_identity::ClientIdentity;
    use crate::simulation::simulation_id::SimulationId;

    #[test]
    fn sizes_and_times_are_short() {
        let sizes = [(0, "none"), (2048, "2 KiB"), (5 << 20, "5.0 MiB"), (130 << 20, "130 MiB"), (3 << 30, "3.0 GiB")];
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
        let identity = ClientIdentity::new(Some("<i>root</i>"), Some("<script>'\"&"));
        let one = Simulation::new(SimulationId::next(), &world, identity);
        for (visitor, has_names) in
            [(Visitor::Anybody, false), (Visitor::Stranger, false), (Visitor::Administrator, true)]
        {
            let html = SimulationRow::new(&one, None, 7200, (visitor, true)).render().unwrap();
            assert!(!html.contains("<script>") && !html.contains("<i>"), "{html}");
            assert_eq!(html.contains("root"), has_names, "{html}");
        }
    }
}
