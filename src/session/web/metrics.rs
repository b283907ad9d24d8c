//! The Prometheus metrics of `/metrics` that follow from the status of the fleet. Counters and histograms are in `app`.

use crate::session::fleet::{FleetStatus, NameStatus, ServerState, ServerStatus};
use crate::shared::http::Gauge;

/// The gauges of `/metrics`.
pub fn gauges<'text>(clients: usize, status: &FleetStatus) -> Vec<Gauge<'text>> {
    let mut gauges = fleet_gauges(clients, status);
    gauges.extend(server_gauges(&status.servers));
    gauges.extend(name_gauges(&status.names));
    gauges
}

/// The gauges of the fleet as a whole.
fn fleet_gauges<'text>(clients: usize, status: &FleetStatus) -> Vec<Gauge<'text>> {
    let count = |wanted: ServerState| status.servers.iter().filter(move |server| server.record.state == wanted).count();
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
            status.displayed_mean_load(),
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
                Some(f64::from(u8::from(!matches!(server.record.state, ServerState::Down | ServerState::Unknown))))
            }),
        },
        Gauge {
            name: "webots_session_server_load_percent",
            help: "Load that a simulation server reported last",
            labels,
            values: of_each(&|server| server.record.current().map(|report| report.load.percent())),
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
            values: of_each(&|server| server.record.latency.map(|latency| latency.as_secs_f64())),
        },
    ]
}

/// The gauges of each name that resolves to simulation servers.
fn name_gauges<'text>(names: &[NameStatus]) -> Vec<Gauge<'text>> {
    let of_each =
        |value: &dyn Fn(&NameStatus) -> f64| names.iter().map(|name| (vec![name.name.clone()], value(name))).collect();
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
