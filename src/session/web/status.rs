//! The fleet for other programs: `/status` and `/metrics`.

use std::time::Duration;

use serde::Serialize;

use crate::session::fleet::{FleetStatus, NameStatus, ServerState, ServerStatus, displayed_mean_load};
use crate::session::state::AppState;
use crate::shared::domain::ClientUrls;
use crate::shared::domain::Instances;
use crate::shared::domain::Load;
use crate::shared::http::Gauge;
use crate::shared::run::timestamp;

/// The page `/status`.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct StatusResponse {
    version: &'static str,
    /// In seconds.
    uptime: u64,
    available: bool,
    clients: usize,
    /// In percent; absent if no server answers.
    load: Option<f64>,
    servers: Vec<ServerStatusJson>,
    names: Vec<NameStatusJson>,
    changes: Vec<StateChangeJson>,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct ServerStatusJson {
    address: String,
    monitor: String,
    state: &'static str,
    since: String,
    load: Option<Load>,
    effective_load: Option<f64>,
    in_flight: usize,
    client_cost: Option<f64>,
    instances: Option<Instances>,
    allowed_repositories: Vec<String>,
    version: String,
    /// Seconds since the last good answer.
    age: Option<f64>,
    /// In seconds.
    latency: Option<f64>,
    error: Option<String>,
}

#[derive(Debug, Serialize)]
struct NameStatusJson {
    name: String,
    servers: usize,
    since: String,
    error: Option<String>,
}

#[derive(Debug, Serialize)]
struct StateChangeJson {
    at: String,
    server: String,
    state: &'static str,
    why: String,
}

impl StatusResponse {
    /// The state of the fleet.
    pub fn new(server: &AppState, status: &FleetStatus) -> Self {
        let changes = status.changes.iter().map(|change| StateChangeJson {
            at: timestamp(change.at),
            server: change.server.clone(),
            state: change.state.word(),
            why: change.why.clone(),
        });
        let names = status.names.iter().map(|name| NameStatusJson {
            name: name.name.to_string(),
            servers: name.servers,
            since: timestamp(name.since),
            error: name.error.clone(),
        });
        Self {
            version: env!("CARGO_PKG_VERSION"),
            uptime: server.started.elapsed().as_secs(),
            available: status.available,
            clients: server.clients(),
            load: status.mean_load,
            servers: status.servers.iter().map(|one| ServerStatusJson::new(one, &server.client_urls)).collect(),
            names: names.collect(),
            changes: changes.collect(),
        }
    }
}

impl ServerStatusJson {
    fn new(server: &ServerStatus, urls: &ClientUrls) -> Self {
        let known = server.report.as_ref().filter(|_| server.state != ServerState::Down);
        let allowed =
            known.map(|report| report.allowed_repositories.iter().map(|prefix| prefix.as_str().to_owned()).collect());
        Self {
            address: server.address.to_string(),
            monitor: format!("{}/monitor", urls.http_url(&server.address)),
            state: server.state.word(),
            since: timestamp(server.since),
            load: known.map(|report| report.load),
            effective_load: server.effective_load,
            in_flight: server.in_flight,
            client_cost: server.client_cost,
            instances: known.and_then(|report| report.instances),
            allowed_repositories: allowed.unwrap_or_default(),
            version: known.map(|report| report.version.clone()).unwrap_or_default(),
            age: server.answered.map(|answered| answered.elapsed().as_secs_f64()),
            latency: server.latency.as_ref().map(Duration::as_secs_f64),
            error: server.error.clone(),
        }
    }
}

/// The gauges of `/metrics`.
pub fn gauges<'text>(clients: usize, status: &FleetStatus) -> Vec<Gauge<'text>> {
    let mut gauges = fleet_gauges(clients, status);
    gauges.extend(server_gauges(&status.servers));
    gauges.extend(name_gauges(&status.names));
    gauges
}

/// The gauges of the fleet as a whole.
fn fleet_gauges<'text>(clients: usize, status: &FleetStatus) -> Vec<Gauge<'text>> {
    let count = |wanted: ServerState| status.servers.iter().filter(move |server| server.state == wanted).count();
    let every = [ServerState::Unknown, ServerState::Up, ServerState::Full, ServerState::Draining, ServerState::Down];
    vec![
        Gauge::plain(
            "webots_session_available",
            "1 while some simulation server can take a client",
            f64::from(u8::from(status.available)),
        ),
        Gauge::plain("webots_session_clients", "Web clients connected", number(clients)),
        Gauge::plain(
            "webots_session_load_percent",
            "Mean load of the servers that answer, -1 where none does",
            displayed_mean_load(status.mean_load),
        ),
        Gauge {
            name: "webots_session_servers",
            help: "Simulation servers by state",
            labels: &["state"],
            values: every.iter().map(|one| (vec![one.word().to_owned()], number(count(*one)))).collect(),
        },
    ]
}

/// The gauges of each simulation server.
fn server_gauges<'text>(servers: &[ServerStatus]) -> Vec<Gauge<'text>> {
    let of_each = |value: &dyn Fn(&ServerStatus) -> Option<f64>| {
        servers.iter().filter_map(|server| Some((vec![server.address.to_string()], value(server)?))).collect()
    };
    let labels: &[&str] = &["server"];
    vec![
        Gauge {
            name: "webots_session_server_up",
            help: "1 while a simulation server gives good answers",
            labels,
            values: of_each(&|server| {
                Some(f64::from(u8::from(!matches!(server.state, ServerState::Down | ServerState::Unknown))))
            }),
        },
        Gauge {
            name: "webots_session_server_load_percent",
            help: "Load that a simulation server reported last",
            labels,
            values: of_each(&|server| {
                server.report.as_ref().filter(|_| server.state != ServerState::Down).map(|report| report.load.percent())
            }),
        },
        Gauge {
            name: "webots_session_server_effective_load_percent",
            help: "The same, and the clients that it can't show yet",
            labels,
            values: of_each(&|server| server.effective_load),
        },
        Gauge {
            name: "webots_session_server_in_flight",
            help: "Clients that were sent to a simulation server and have not come yet",
            labels,
            values: of_each(&|server| Some(number(server.in_flight))),
        },
        Gauge {
            name: "webots_session_server_latency_seconds",
            help: "Time in which a simulation server answered last",
            labels,
            values: of_each(&|server| server.latency.map(|latency| latency.as_secs_f64())),
        },
    ]
}

/// The gauges of each name that resolves to simulation servers.
fn name_gauges<'text>(names: &[NameStatus]) -> Vec<Gauge<'text>> {
    let of_each = |value: &dyn Fn(&NameStatus) -> f64| {
        names.iter().map(|name| (vec![name.name.to_string()], value(name))).collect()
    };
    vec![
        Gauge {
            name: "webots_session_lookup_up",
            help: "1 while a name of simulation servers can be looked up",
            labels: &["name"],
            values: of_each(&|name| f64::from(u8::from(name.error.is_none()))),
        },
        Gauge {
            name: "webots_session_lookup_servers",
            help: "Simulation servers that a name leads to",
            labels: &["name"],
            values: of_each(&|name| number(name.servers)),
        },
    ]
}

#[expect(clippy::cast_precision_loss, reason = "counts here are far below 2^52")]
fn number(count: usize) -> f64 {
    count as f64
}
