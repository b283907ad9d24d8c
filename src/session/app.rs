//! The session server as a whole: its parts, its start and its shutdown.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use actix_web::{App, web};
use tokio::sync::watch;

use super::announcements::Announcements;
use super::config::{Announcement, SessionConfig};
use super::state::AppState;
use crate::session::fleet::{GetStatus, Reconfigure, Registry};
use crate::session::web::configure;
use crate::shared::config;
use crate::shared::http::server::{self, HttpServerOptions};
use crate::shared::http::{BasicAuth, ConnectionLimiter, LiveUpdates, Metrics};
use crate::shared::run::{
    AppError, Phase, ServerCommand, Signals, limit_clients, permanent, raise_open_files, service_manager, start,
};

/// Open files that the server itself needs: logs, threads, mail.
const OWN_FILES: usize = 128;
/// Connections to one simulation server: one in use, one that is closing.
const FILES_PER_SERVER: usize = 2;
/// Simulation servers behind one name for which open files are reserved.
const SERVERS_PER_NAME: usize = 1000;

/// Values of the metric's label `outcome`. All of them are exported from the start.
const OUTCOMES: [&str; 4] = ["placed", "unavailable", "not_accepted", "wrong_url"];

/// Runs the server until a signal stops it. SIGHUP reads the configuration `file` again.
///
/// # Errors
/// When the server can't start, or an actor that must live has stopped.
pub async fn run(mut config: SessionConfig, file: PathBuf) -> Result<(), AppError> {
    let mut signals = Signals::catch()?;
    let files = raise_open_files(u64::MAX);
    let (connections, clients) = bound_clients(files, &config)?;
    let options = options(&config, connections);
    let connections = ConnectionLimiter::new(connections, clients, config.max_clients_per_address);
    let (phase_sender, phase) = watch::channel(Phase::Open);
    let address = SocketAddr::new(config.bind, config.port);
    let socket = server::listen(address).map_err(|error| format!("can't listen on {address}: {error}"))?;
    let port = socket.local_addr()?.port();
    config.port = port;
    let stop = config.timing.stop;
    let (http_url, websocket_url) = (config.http_url(), config.websocket_url());
    let server = Arc::new(assemble(config, connections, phase)?);
    let shared = web::Data::from(Arc::clone(&server));
    let app = move || App::new().app_data(shared.clone()).configure(configure);
    let http = server::serve(socket, server.connections.clone(), options, app)?;
    let handle = http.handle();
    let serving = actix_rt::spawn(http);
    start::announce("session server", &http_url, &websocket_url, port);
    let registry = server.registry.clone();
    actix_rt::spawn(service_manager::feed_watchdog(async move || registry.send(GetStatus).await.is_ok()));
    tokio::select! {
        () = handle_commands(&mut signals, &file, &server) => {}
        fault = permanent::stopped("Registry", server.registry.clone()) => return Err(fault.into()),
    }
    log::info!("stopping");
    service_manager::stopping("stopping");
    phase_sender.send_replace(Phase::Closing);
    // Connections that don't end in time are cut.
    actix_rt::time::timeout(stop, handle.stop(true)).await.ok();
    drop(serving);
    log::info!("stopped");
    Ok(())
}

/// Handles signals, until the server must stop.
async fn handle_commands(signals: &mut Signals, file: &Path, server: &AppState) {
    let mut announced = server.config.announcement.clone();
    loop {
        match signals.next().await {
            ServerCommand::Stop => return,
            ServerCommand::Reload => reload(file, server, &mut announced),
            ServerCommand::Drain => log::info!("SIGUSR1 changes nothing here: simulation servers are drained"),
        }
    }
}

/// Options of the HTTP server for this many connections.
fn options(config: &SessionConfig, connections: usize) -> HttpServerOptions {
    HttpServerOptions {
        max_connections: connections,
        silence: config.timing.silence,
        stop: config.timing.stop,
        trusted_proxies: config.trusted_proxies.clone(),
    }
}

/// Returns the limits of connections and of clients, so that `files` open files are enough for them and the rest of the
/// server. The limit of clients is lower: the remaining connections serve the error that there are too many clients.
fn bound_clients(files: u64, config: &SessionConfig) -> Result<(usize, usize), String> {
    let all = usize::try_from(files).unwrap_or(usize::MAX);
    let names = config.simulation_servers.iter().filter(|entry| entry.name().is_some()).count();
    let servers = config.simulation_servers.len() - names;
    // It is not known yet how many servers the names resolve to: they reserve at most a quarter.
    let looked_up = (FILES_PER_SERVER * SERVERS_PER_NAME * names).min(all / 4);
    let connections = all.saturating_sub(OWN_FILES + FILES_PER_SERVER * servers + looked_up);
    let possible = connections - connections / 16;
    Ok((connections, limit_clients(files, possible, config.max_clients, "one client")?))
}

/// Creates the server's state, and starts its actors.
fn assemble(
    config: SessionConfig,
    connections: ConnectionLimiter,
    phase: watch::Receiver<Phase>,
) -> Result<AppState, AppError> {
    let metrics = Metrics::default();
    let latencies = metrics.histogram("webots_session_report_seconds", "Time in which simulation servers answer")?;
    let picks = metrics.counter("webots_session_requests_total", "Requests for a simulation server", "outcome")?;
    for outcome in OUTCOMES {
        picks.with_label_values(&[outcome]).reset();
    }
    let announcements = Announcements::start(config.announcement.clone());
    let (available_sender, available) = watch::channel(false);
    let config = Arc::new(config);
    let registry = Registry::start(Arc::clone(&config), latencies, available_sender);
    Ok(AppState {
        registry,
        available,
        client_urls: config.client_urls(),
        phase,
        connections,
        metrics,
        picks,
        live: LiveUpdates::default(),
        announcements,
        admin_auth: config.admin_password.clone().map(BasicAuth::new),
        started: Instant::now(),
        config,
    })
}

/// Reads the configuration file again. One that can't be used changes nothing. `announced` is the announcement that it
/// had before: an unchanged one does not replace what was posted since.
fn reload(file: &Path, server: &AppState, announced: &mut Option<Announcement>) {
    match config::load::<SessionConfig>(file) {
        Ok(loaded) => {
            for warning in &loaded.warnings {
                log::warn!("{warning}");
            }
            let entries = loaded.config.simulation_servers.len();
            log::info!("read {} again: {entries} entries in simulationServers", file.display());
            if *announced != loaded.config.announcement {
                announced.clone_from(&loaded.config.announcement);
                server.announcements.set(announced.clone());
            }
            // The URLs of the fleet stay as they were at the start.
            let config = SessionConfig { ssl: server.config.ssl, ..loaded.config };
            server.registry.do_send(Reconfigure(Arc::new(config)));
        }
        Err(error) => log::error!("the configuration stays as it was: {error}"),
    }
}
