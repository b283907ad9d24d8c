//! The Prometheus metrics of `/metrics` that follow from the status of the fleet. Counters and histograms
//! are in `app`.

use crate::session::fleet::{FleetStatus, NameStatus, ServerStatus, StateName};
use crate::shared::http::Gauge;

/// The gauges of `/metrics`.
pub fn gauges<'text>(clients: usize, status: &FleetStatus) -> Vec<Gauge<'text>> {
    let of_servers = |name, help, value: &dyn Fn(&ServerStatus) -> Option<f64>| {
        let value = |server: &ServerStatus| Some((vec![server.record.address.to_string()], value(server)?));
        Gauge {
            name,
            help,
            labels: &["server"],
            values: status.servers.iter().filter_map(value).collect(),
        }
    };
    let of_names = |name, help, value: &dyn Fn(&NameStatus) -> f64| {
        let value = |one: &NameStatus| (vec![one.name.clone()], value(one));
        Gauge {
            name,
            help,
            labels: &["name"],
            values: status.names.iter().map(value).collect(),
        }
    };
    vec![
        Gauge::plain(
            "webots_session_available",
            "1 while some simulation server can take a client",
            f64::from(u8::from(status.available)),
        ),
        Gauge::plain("webots_session_clients", "Web clients connected", number(clients)),
        Gauge::plain(
            "webots_session_waiting",
            "Clients that wait in the line",
            number(status.line.waiting),
        ),
        Gauge::plain(
            "webots_session_waiting_longest_seconds",
            "How long the first client of the line has waited",
            status.line.longest().as_secs_f64(),
        ),
        Gauge::plain(
            "webots_session_load_percent",
            "Mean load of the servers that answer, -1 where none does",
            status.mean_load.unwrap_or(-1.0),
        ),
        Gauge {
            name: "webots_session_servers",
            help: "Simulation servers by state",
            labels: &["state"],
            values: StateName::ALL
                .iter()
                .map(|state| (vec![state.to_string()], number(status.count(*state))))
                .collect(),
        },
        of_servers(
            "webots_session_server_up",
            "1 while a simulation server gives good answers",
            &|server| Some(f64::from(u8::from(server.record.state.report().is_some()))),
        ),
        of_servers(
            "webots_session_server_load_percent",
            "Load that a simulation server reported last",
            &|server| server.record.state.report().map(|report| report.load.percent()),
        ),
        of_servers(
            "webots_session_server_effective_load_percent",
            "The same, and the clients that it can't show yet",
            &|server| server.effective_load,
        ),
        of_servers(
            "webots_session_server_in_flight",
            "Clients that were sent to a simulation server and have not come yet",
            &|server| Some(number(server.in_flight)),
        ),
        of_servers(
            "webots_session_server_latency_seconds",
            "Time in which a simulation server answered last",
            &|server| server.record.state.latency().map(|latency| latency.as_secs_f64()),
        ),
        of_names(
            "webots_session_lookup_up",
            "1 while a name of simulation servers can be looked up",
            &|name| f64::from(u8::from(name.error.is_none())),
        ),
        of_names(
            "webots_session_lookup_servers",
            "Simulation servers that a name leads to",
            &|name| number(name.servers),
        ),
    ]
}

#[expect(clippy::cast_precision_loss, reason = "counts here are far below 2^52")]
fn number(count: usize) -> f64 {
    count as f64
}
