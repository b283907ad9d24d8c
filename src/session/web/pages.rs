//! The session server's HTML pages: the monitor of its fleet, and the viewer.

use std::collections::VecDeque;
use std::time::{Duration, SystemTime};

use askama::Template;

use crate::session::config::{Announcement, Example};
use crate::session::fleet::{FleetStatus, ServerState, ServerStatus, StateChange};
use crate::shared::domain::{ClientUrls, Instances};
use crate::shared::http::{PageView, TableRow};
use crate::shared::run::timestamp;
use crate::shared::text::one_line;

/// The whole page `/monitor`.
#[derive(Template)]
#[template(path = "session/monitor.html")]
struct Monitor<'view> {
    version: &'static str,
    started: String,
    /// Whether administrators can do something here.
    has_actions: bool,
    view: &'view PageView,
}

/// The summary of the fleet.
#[derive(Template)]
#[template(path = "session/glance.html")]
struct Glance<'status> {
    status: &'status FleetStatus,
    clients: usize,
    answering: usize,
    taking: usize,
    down: usize,
    running: u64,
    idle: u64,
    starting: u64,
    queued: u64,
    places: u64,
}

/// The cells of one simulation server.
#[derive(Template)]
#[template(path = "session/row.html")]
struct ServerRow<'server> {
    server: &'server ServerStatus,
    monitor: String,
    rank: u8,
    error: Option<&'server str>,
    load: Option<f64>,
    load_value: f64,
    effective_value: f64,
    instances: Option<Instances>,
    repositories: Vec<String>,
    accepted: &'static str,
    version: &'server str,
    latency: String,
    latency_value: u128,
    since: String,
}

/// The administrator's announcement.
#[derive(Template)]
#[template(path = "session/announcement.html")]
struct Announced<'one> {
    text: &'one str,
    until: Option<String>,
}

/// The last changes of state.
#[derive(Template)]
#[template(path = "session/changes.html")]
struct Changes<'status> {
    changes: &'status VecDeque<StateChange>,
}

/// The page `/viewer`.
#[derive(Template)]
#[template(path = "session/viewer.html")]
pub struct Viewer<'config> {
    /// Version of the server.
    pub version: &'static str,
    /// Worlds that the page offers.
    pub examples: &'config [Example],
    /// URL of Webots' own viewer, if `viewerScript` is set.
    pub script: Option<&'config str>,
}

/// The page that holds Webots' own viewer.
#[derive(Template)]
#[template(path = "session/webots_viewer.html")]
pub struct WebotsViewer {
    /// Version of the server.
    pub version: &'static str,
}

/// The parts of `/monitor` that change.
///
/// # Errors
/// When a template can't be rendered.
pub fn view(
    status: &FleetStatus,
    clients: usize,
    urls: &ClientUrls,
    announcement: Option<&Announcement>,
) -> Result<PageView, askama::Error> {
    let rows = status.servers.iter().map(|server| {
        let html = ServerRow::new(server, urls).render()?;
        Ok(TableRow { key: server.record.address.to_string(), html })
    });
    let rows = rows.collect::<Result<Vec<TableRow>, askama::Error>>()?;
    let announced = announcement.map(|one| Announced { text: &one.text, until: one.until.map(timestamp) }.render());
    let parts = [
        ("announcement", announced.transpose()?.unwrap_or_default()),
        ("glance", Glance::new(status, clients).render()?),
        ("changes", Changes { changes: &status.changes }.render()?),
    ];
    Ok(PageView { parts: parts.into(), tables: [("servers", rows)].into(), sample: Vec::new() })
}

/// The whole of `/monitor`.
///
/// # Errors
/// When a template can't be rendered.
pub fn monitor(
    status: &FleetStatus,
    clients: usize,
    urls: &ClientUrls,
    started: SystemTime,
    (announcement, has_actions): (Option<&Announcement>, bool),
) -> Result<String, askama::Error> {
    let view = view(status, clients, urls, announcement)?;
    let started = timestamp(started);
    Monitor { version: env!("CARGO_PKG_VERSION"), started, has_actions, view: &view }.render()
}

impl<'status> Glance<'status> {
    fn new(status: &'status FleetStatus, clients: usize) -> Self {
        let count = |wanted: &[ServerState]| {
            status.servers.iter().filter(|server| wanted.contains(&server.record.state)).count()
        };
        let instances: Vec<_> = status.servers.iter().filter_map(|one| one.record.current()?.instances).collect();
        // Numbers that another server reports may be arbitrarily large.
        let sum = |part: fn(&Instances) -> u32| instances.iter().map(|one| u64::from(part(one))).sum();
        Self {
            status,
            clients,
            answering: count(&[ServerState::Up, ServerState::Full, ServerState::Draining]),
            taking: count(&[ServerState::Up]),
            down: count(&[ServerState::Down]),
            running: sum(|one| one.running),
            idle: sum(|one| one.idle),
            starting: sum(|one| one.starting),
            queued: sum(|one| one.queued),
            places: sum(|one| one.places),
        }
    }
}

impl<'server> ServerRow<'server> {
    fn new(server: &'server ServerStatus, urls: &ClientUrls) -> Self {
        let (record, report) = (&server.record, server.record.current());
        let load = report.map(|report| report.load.percent());
        let repositories = report.map(|report| report.allowed_repositories.as_slice()).unwrap_or_default();
        let accepted = match report {
            None => "–",
            Some(report) if report.docker.is_none() => "any that it does not rule out",
            Some(_) => "none",
        };
        Self {
            server,
            monitor: format!("{}/monitor", urls.http_url(&server.record.address)),
            rank: record.state as u8,
            error: server.error.as_deref().filter(|_| record.state == ServerState::Down),
            load,
            load_value: sort_value(load),
            effective_value: sort_value(server.effective_load),
            instances: report.and_then(|report| report.instances),
            repositories: repositories.iter().map(|prefix| one_line(without_scheme(prefix.as_str()))).collect(),
            accepted,
            version: report.map(|report| report.version.as_str()).unwrap_or_default(),
            latency: record.latency.map(milliseconds).unwrap_or_default(),
            latency_value: record.latency.unwrap_or_default().as_micros(),
            since: timestamp(record.since),
        }
    }
}

impl Changes<'_> {
    fn time(at: &SystemTime) -> String {
        timestamp(*at)
    }
}

fn without_scheme(url: &str) -> &str {
    url.split_once("://").map_or(url, |(_, rest)| rest)
}

/// A latency as text, rounded so that the page of an idle fleet does not change.
fn milliseconds(time: Duration) -> String {
    match time.as_millis() {
        0 => "< 1 ms".to_owned(),
        millis @ 1..1000 => format!("{millis} ms"),
        _ => format!("{:.1} s", time.as_secs_f64()),
    }
}

/// The value by which rows are sorted; unknown values come first.
fn sort_value(number: Option<f64>) -> f64 {
    number.map_or(-1.0, |number| (number * 10.0).round() / 10.0)
}
