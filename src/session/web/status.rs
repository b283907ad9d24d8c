//! The fleet for other programs: `/status`.

use std::collections::VecDeque;
use std::time::{Duration, SystemTime};

use serde::Serialize;

use crate::session::fleet::{FleetStatus, NameStatus, ServerState, ServerStatus, StateChange};
use crate::session::state::AppState;
use crate::shared::domain::{ClientUrls, Instances, Load, PublicAddress, UrlPrefix};
use crate::shared::run::serialize_timestamp;

/// The page `/status`.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct StatusResponse<'status> {
    version: &'static str,
    /// In seconds.
    uptime: u64,
    available: bool,
    clients: usize,
    /// In percent; absent if no server answers.
    load: Option<f64>,
    servers: Vec<ServerStatusJson<'status>>,
    names: &'status [NameStatus],
    changes: &'status VecDeque<StateChange>,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct ServerStatusJson<'status> {
    address: &'status PublicAddress,
    monitor: String,
    state: ServerState,
    #[serde(serialize_with = "serialize_timestamp")]
    since: SystemTime,
    load: Option<Load>,
    effective_load: Option<f64>,
    in_flight: usize,
    client_cost: Option<f64>,
    instances: Option<Instances>,
    allowed_repositories: &'status [UrlPrefix],
    version: &'status str,
    /// Seconds since the last good answer.
    age: Option<f64>,
    /// In seconds.
    latency: Option<f64>,
    error: Option<&'status str>,
}

impl<'status> StatusResponse<'status> {
    /// The state of the fleet.
    pub fn new(server: &AppState, status: &'status FleetStatus) -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION"),
            uptime: server.started.elapsed().as_secs(),
            available: status.available,
            clients: server.clients(),
            load: status.mean_load,
            servers: status.servers.iter().map(|one| ServerStatusJson::new(one, &server.client_urls)).collect(),
            names: &status.names,
            changes: &status.changes,
        }
    }
}

impl<'status> ServerStatusJson<'status> {
    fn new(server: &'status ServerStatus, urls: &ClientUrls) -> Self {
        let (record, report) = (&server.record, server.record.current());
        Self {
            address: &server.address,
            monitor: format!("{}/monitor", urls.http_url(&server.address)),
            state: record.state,
            since: record.since,
            load: report.map(|report| report.load),
            effective_load: server.effective_load,
            in_flight: server.in_flight,
            client_cost: server.client_cost,
            instances: report.and_then(|report| report.instances),
            allowed_repositories: report.map(|report| report.allowed_repositories.as_slice()).unwrap_or_default(),
            version: report.map(|report| report.version.as_str()).unwrap_or_default(),
            age: record.answered.map(|answered| answered.elapsed().as_secs_f64()),
            latency: record.latency.as_ref().map(Duration::as_secs_f64),
            error: server.error.as_deref(),
        }
    }
}
