//! The fleet for other programs: `/status`.

use std::time::Duration;

use serde_json::{Value, json};

use crate::session::fleet::{FleetStatus, ServerStatus};
use crate::session::line::{LineStatus, WaitingFor};
use crate::session::state::AppState;
use crate::shared::domain::{ClientUrls, Failure, ReadyCount};

/// The page `/status`. Loads are in percent, times in seconds; unknown values are `null`.
pub fn status_page(server: &AppState, status: &FleetStatus) -> Value {
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "uptime": server.started.elapsed().as_secs(),
        "available": status.available,
        "clients": server.clients(),
        "load": status.mean_load,
        "servers": status.servers.iter().map(|one| server_status(one, &server.client_urls)).collect::<Vec<_>>(),
        "names": status.names,
        "changes": status.changes,
        "line": line_status(&status.line),
        "ready": status.ready.iter().map(|one| ready_status(one, status)).collect::<Vec<_>>(),
        "requested": status.requested,
    })
}

/// Most repositories that are listed.
const MAX_LISTED: usize = 50;

fn ready_status(one: &ReadyCount, status: &FleetStatus) -> Value {
    json!({
        "world": one.world,
        "mode": one.mode,
        "wanted": one.count,
        "ready": status.ready(one),
    })
}

fn line_status(line: &LineStatus) -> Value {
    let world = |one: &WaitingFor| {
        json!({
            "repository": one.repository,
            "waiting": one.waiting,
            "longest": one.longest.as_secs_f64(),
        })
    };
    json!({
        "waiting": line.waiting,
        "longest": line.longest().as_secs_f64(),
        "worlds": line.worlds.iter().take(MAX_LISTED).map(world).collect::<Vec<_>>(),
    })
}

fn server_status(server: &ServerStatus, urls: &ClientUrls) -> Value {
    let record = &server.record;
    let state = &record.state;
    let report = state.report();
    json!({
        "address": record.address,
        "monitor": format!("{}/monitor", urls.http_url(&record.address)),
        "state": state.name(),
        "since": record.since,
        "load": report.map(|report| report.load),
        "effectiveLoad": server.effective_load,
        "inFlight": server.in_flight,
        "clientCost": server.client_cost,
        "instances": report.and_then(|report| report.instances),
        "ready": report.map(|report| report.ready.as_slice()).unwrap_or_default(),
        "allowedRepositories": report.map(|report| report.allowed_repositories.as_slice()).unwrap_or_default(),
        "version": report.map(|report| report.version.as_str()).unwrap_or_default(),
        // Since the last good answer.
        "age": state.last_answer().map(|answer| answer.at.elapsed().as_secs_f64()),
        "latency": state.latency().as_ref().map(Duration::as_secs_f64),
        "error": server.failure.as_ref().map(Failure::in_full),
        "reason": server.failure.as_ref().map(|failure| failure.reason),
    })
}
