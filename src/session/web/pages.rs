//! The session server's HTML pages: the monitor of its fleet, and the viewer.

use std::collections::VecDeque;
use std::time::{Duration, SystemTime};

use askama::Template;

use crate::session::config::Example;
use crate::session::fleet::{FleetStatus, ServerStatus, StateChange, StateName};
use crate::session::line::WaitingFor;
use crate::shared::domain::{ClientUrls, Instances, ServerReport};
use crate::shared::http::{PageView, TableRow};
use crate::shared::run::timestamp;
use crate::shared::text::one_line;

/// Most repositories in the table of those that are waited for.
const MAX_WORLDS: usize = 50;

/// The whole page `/monitor`.
#[derive(Template)]
#[template(path = "session/monitor.html")]
pub struct Monitor {
    /// When the server was started.
    pub started: String,
    /// Whether the page offers the administrator's actions.
    pub has_actions: bool,
    /// The parts that change.
    pub view: PageView,
}

/// The summary of the fleet.
#[derive(Template)]
#[template(path = "session/glance.html")]
struct Glance<'status> {
    status: &'status FleetStatus,
    clients: usize,
    running: u64,
    idle: u64,
    starting: u64,
    queued: u64,
    slots: u64,
}

/// The cells of one simulation server.
#[derive(Template)]
#[template(path = "session/row.html")]
struct ServerRow<'server> {
    server: &'server ServerStatus,
    /// Its last report, unless it is down.
    report: Option<&'server ServerReport>,
    monitor: String,
}

/// The cells of one repository whose worlds are waited for.
#[derive(Template)]
#[template(path = "session/waiting_row.html")]
struct WaitingRow<'line> {
    waiting: &'line WaitingFor,
}

/// The administrator's announcement.
#[derive(Template)]
#[template(path = "session/announcement.html")]
struct Announced<'a> {
    text: &'a str,
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
    /// Worlds that the page offers.
    pub examples: &'config [Example],
    /// Whether it asks for the visitor's name: nobody else tells it.
    pub asks_name: bool,
    /// Whether the visitor must give one.
    pub needs_name: bool,
    /// URL of Webots' own viewer, if `viewerScript` is set.
    pub script: Option<&'config str>,
}

/// The page `/viewer?embed=1`, for frames of other sites.
#[derive(Template)]
#[template(path = "session/embedded.html")]
pub struct Embedded<'config> {
    /// Whether it asks for the visitor's name.
    pub asks_name: bool,
    /// Whether the visitor must give one.
    pub needs_name: bool,
    /// URL of Webots' own viewer, if `viewerScript` is set.
    pub script: Option<&'config str>,
}

/// The page that holds Webots' own viewer.
#[derive(Template)]
#[template(path = "session/webots_viewer.html")]
pub struct WebotsViewer;

/// The parts of `/monitor` that change. The text of the announcement is empty if there is none.
///
/// # Errors
/// When a template can't be rendered.
pub fn view(
    status: &FleetStatus,
    clients: usize,
    urls: &ClientUrls,
    announcement: &str,
) -> Result<PageView, askama::Error> {
    let rows = status.servers.iter().map(|server| {
        let monitor = format!("{}/monitor", urls.http_url(&server.record.address));
        let html = ServerRow {
            server,
            report: server.record.state.report(),
            monitor,
        }
        .render()?;
        Ok(TableRow {
            key: server.record.address.to_string(),
            html,
        })
    });
    let rows = rows.collect::<Result<Vec<TableRow>, askama::Error>>()?;
    let waiting = status.line.worlds.iter().take(MAX_WORLDS).map(|waiting| {
        Ok(TableRow {
            key: waiting.repository.clone(),
            html: WaitingRow { waiting }.render()?,
        })
    });
    let waiting = waiting.collect::<Result<Vec<TableRow>, askama::Error>>()?;
    let parts = [
        ("announcement", Announced { text: announcement }.render()?),
        ("glance", Glance::new(status, clients).render()?),
        (
            "changes",
            Changes {
                changes: &status.changes,
            }
            .render()?,
        ),
    ];
    Ok(PageView {
        parts: parts.into(),
        tables: [("servers", rows), ("waiting", waiting)].into(),
        sample: Vec::new(),
    })
}

impl<'status> Glance<'status> {
    fn new(status: &'status FleetStatus, clients: usize) -> Self {
        let instances: Vec<_> = status
            .servers
            .iter()
            .filter_map(|server| server.record.state.report()?.instances)
            .collect();
        // Numbers that another server reports may be arbitrarily large.
        let sum = |part: fn(&Instances) -> u32| instances.iter().map(|instances| u64::from(part(instances))).sum();
        Self {
            status,
            clients,
            running: sum(|instances| instances.running),
            idle: sum(|instances| instances.idle),
            starting: sum(|instances| instances.starting),
            queued: sum(|instances| instances.queued),
            slots: sum(|instances| instances.slots),
        }
    }
}

impl WaitingRow<'_> {
    /// When the first of them has come. How long it has waited changes each second, and the page with it.
    fn since(&self) -> String {
        timestamp(SystemTime::UNIX_EPOCH + Duration::from_millis(self.waiting.since))
    }

    fn repository(&self) -> String {
        let url = &self.waiting.repository;
        one_line(url.split_once("://").map_or(url, |(_, rest)| rest))
    }
}

impl ServerRow<'_> {
    fn instances(&self) -> Option<Instances> {
        self.report?.instances
    }

    fn repositories(&self) -> Vec<String> {
        let allowed = self
            .report
            .map(|report| report.allowed_repositories.as_slice())
            .unwrap_or_default();
        let shown = |url: &str| one_line(url.split_once("://").map_or(url, |(_, rest)| rest));
        allowed.iter().map(|prefix| shown(prefix.as_str())).collect()
    }

    /// A latency as text, rounded so that the page of an idle fleet does not change.
    fn milliseconds(time: &Duration) -> String {
        match time.as_millis() {
            0 => "< 1 ms".to_owned(),
            millis @ 1..1000 => format!("{millis} ms"),
            _ => format!("{:.1} s", time.as_secs_f64()),
        }
    }
}
