//! The session server as a whole: its parts, its start and its shutdown.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix_web::{App, web};
use tokio::sync::watch;

use super::config::SessionConfig;
use super::state::{AppState, PLACED};
use crate::session::class::Roster;
use crate::session::fleet::{GetStatus, ReadyRequests, Reconfigure, Registry};
use crate::session::web::configure;
use crate::shared::config;
use crate::shared::domain::{ClientUrls, FleetKey, Reason};
use crate::shared::http::server::{self, HttpServerOptions, Source};
use crate::shared::http::{AdminAuth, AuthSettings, ConnectionLimiter, LiveUpdates, Metrics, SharedPage};
use crate::shared::run::{
    AppError, Phase, ServerCommand, Signals, limit_clients, permanent, raise_open_files, service_manager, start,
};

/// Open files that the server itself needs: logs, threads, mail.
const OWN_FILES: usize = 128;
/// Connections to one simulation server: one in use, one that is closing, and one for the slots of the line.
const FILES_PER_SERVER: usize = 3;

/// Timeout for closing open connections at shutdown, which takes at most five seconds in all.
const STOP_TIMEOUT: Duration = Duration::from_secs(4);

/// Upper bounds of the histogram of waiting times, in seconds.
const WAITED: [f64; 10] = [0.1, 1.0, 5.0, 15.0, 60.0, 180.0, 600.0, 1800.0, 3600.0, 7200.0];

/// The reasons for which no simulation server is chosen. The metric of each is exported from the start.
const REFUSALS: [Reason; 5] = [
    Reason::NoServerAvailable,
    Reason::NoIdleTime,
    Reason::RepositoryNotAllowed,
    Reason::RepositoryBlocked,
    Reason::InvalidWorld,
];

/// Runs the server until a signal stops it. SIGHUP reads the configuration `file` again.
///
/// # Errors
/// When the server can't start, or an actor that must live has stopped.
pub async fn run(mut config: SessionConfig, file: PathBuf) -> Result<(), AppError> {
    let mut signals = Signals::catch()?;
    let files = raise_open_files(u64::MAX);
    let (connections, clients) = bound_clients(files, &config)?;
    let options = HttpServerOptions {
        max_connections: connections,
        silence: config.timing.silence,
        stop: STOP_TIMEOUT,
        trusted_proxies: config.trusted_proxies.clone(),
        router: None,
    };
    let connections = ConnectionLimiter::new(connections, clients, config.max_clients_per_address);
    let (phase_sender, phase) = watch::channel(Phase::Open);
    let address = SocketAddr::new(config.bind, config.port);
    let socket = server::listen(address).map_err(|error| format!("can't listen on {address}: {error}"))?;
    let port = socket.local_addr()?.port();
    config.port = port;
    let http_url = config.http_url();
    let websocket_url = config.websocket_url();
    let server = Arc::new(assemble(config, connections, phase)?);
    let shared = web::Data::from(Arc::clone(&server));
    let auth = web::Data::from(Arc::clone(&server.admin_auth));
    let app = move || {
        App::new()
            .app_data(shared.clone())
            .app_data(auth.clone())
            .configure(configure)
    };
    let http = server::serve(Source::Port(socket), server.connections.clone(), options, app)?;
    let handle = http.handle();
    let mut serving = actix_rt::spawn(http);
    start::announce("session server", &http_url, &websocket_url, port);
    let registry = server.registry.clone();
    actix_rt::spawn(service_manager::feed_watchdog(async move || {
        registry.send(GetStatus).await.is_ok()
    }));
    tokio::select! {
        stopped = until_stopped(&mut signals, &file, &server) => stopped?,
        ended = &mut serving => return Err(server::fault(ended).into()),
    }
    log::info!("stopping");
    service_manager::stopping("stopping");
    phase_sender.send_replace(Phase::Closing);
    // Connections that don't end in time are cut.
    actix_rt::time::timeout(STOP_TIMEOUT, handle.stop(true)).await.ok();
    drop(serving);
    log::info!("stopped");
    Ok(())
}

/// Waits until a signal stops the server.
///
/// # Errors
/// When the registry has panicked.
async fn until_stopped(signals: &mut Signals, file: &Path, server: &AppState) -> Result<(), AppError> {
    tokio::select! {
        () = handle_commands(signals, file, server) => Ok(()),
        fault = permanent::stopped("Registry", server.registry.clone()) => Err(fault.into()),
    }
}

/// Handles signals, until the server must stop.
async fn handle_commands(signals: &mut Signals, file: &Path, server: &AppState) {
    loop {
        match signals.next().await {
            ServerCommand::Stop => return,
            ServerCommand::Reload => reload(file, server),
            ServerCommand::Drain => log::info!("SIGUSR1 changes nothing here: simulation servers are drained"),
        }
    }
}

/// Returns the limits of connections and of clients that `files` open files allow. The limit of clients is lower: the
/// remaining connections answer further clients with an error.
fn bound_clients(files: u64, config: &SessionConfig) -> Result<(usize, usize), String> {
    let all = usize::try_from(files).unwrap_or(usize::MAX);
    // The names are not resolved yet, so their servers reserve a quarter.
    let has_names = config.simulation_servers.iter().any(|entry| entry.name().is_some());
    let servers = if has_names {
        all / 4
    } else {
        FILES_PER_SERVER * config.simulation_servers.len()
    };
    let connections = all.saturating_sub(OWN_FILES + servers);
    let possible = connections - connections / 16;
    Ok((
        connections,
        limit_clients(files, possible, config.max_clients, "one client")?,
    ))
}

/// Creates the server's state, and starts its actors.
fn assemble(
    config: SessionConfig,
    connections: ConnectionLimiter,
    phase: watch::Receiver<Phase>,
) -> Result<AppState, AppError> {
    let metrics = Metrics::default();
    let picks = metrics.counter(
        "webots_session_requests_total",
        "Requests for a simulation server",
        "outcome",
    )?;
    for outcome in REFUSALS.map(Reason::code).into_iter().chain([PLACED]) {
        picks.with_label_values(&[outcome]).reset();
    }
    let (available_sender, available) = watch::channel(false);
    let config = Arc::new(config);
    let waited = metrics.histogram(
        "webots_session_waited_seconds",
        "How long clients have waited in the line until it was their turn",
        &WAITED,
    )?;
    let roster = Arc::new(Roster::default());
    let (ready_requests, requested) = ReadyRequests::open(&config);
    let registry = Registry::start(
        Arc::clone(&config),
        available_sender,
        waited,
        Arc::clone(&roster),
        requested,
    )?;
    let key = config.fleet_key.as_ref().map(|key| FleetKey::new(key.reveal()));
    let key = key.unwrap_or_else(FleetKey::random);
    let admin_auth = AdminAuth::new(AuthSettings {
        password: config.admin_password.clone(),
        tokens: config.api_tokens.clone(),
        key: key.clone(),
        has_fleet: config.fleet_key.is_some(),
        server_run: None,
        port: config.port,
        ssl: config.ssl,
        trusted_proxies: config.trusted_proxies.clone(),
        user_header: config.user_header.clone(),
        home: "class",
    });
    Ok(AppState {
        key,
        registry,
        ready_requests,
        roster,
        run: rand::random(),
        line_seen: tokio::sync::Mutex::default(),
        available,
        client_urls: ClientUrls {
            ssl: config.ssl,
            public: config.public_url.clone(),
        },
        phase,
        connections,
        metrics,
        picks,
        monitor: SharedPage::default(),
        live: LiveUpdates::default(),
        announcement: watch::Sender::default(),
        admin_auth: Arc::new(admin_auth),
        started: Instant::now(),
        config,
    })
}

/// Reloads the configuration file. An invalid file changes nothing.
fn reload(file: &Path, server: &AppState) {
    match config::load::<SessionConfig>(file) {
        Ok(loaded) => {
            for warning in loaded.remarks() {
                log::warn!("{warning}");
            }
            let entries = loaded.config.simulation_servers.len();
            log::info!("read {} again: {entries} entries in simulationServers", file.display());
            // What clients have got follows the values of these keys from the start, so the monitors keep them too.
            let config = SessionConfig {
                port: server.config.port,
                ssl: server.config.ssl,
                fleet_key: server.config.fleet_key.clone(),
                ..loaded.config
            };
            server.registry.do_send(Reconfigure(Arc::new(config)));
        }
        Err(error) => log::error!("the configuration stays as it was: {error}"),
    }
}

#[cfg(test)]
mod tests {
    use actix::prelude::*;

    use super::*;

    /// A registry that receives this panics.
    #[derive(Message)]
    #[rtype(result = "()")]
    struct Panic;

    impl Handler<Panic> for Registry {
        type Result = ();

        fn handle(&mut self, _: Panic, _: &mut Self::Context) {
            // Panics without printing.
            std::panic::resume_unwind(Box::new("a test has asked for it"));
        }
    }

    #[actix_rt::test]
    async fn a_registry_that_panics_ends_the_server() {
        let config: SessionConfig = serde_json::from_str(r#"{"simulationServers": ["127.0.0.1:1"]}"#).unwrap();
        let connections = ConnectionLimiter::new(10, 10, None);
        let (_phase, phase) = watch::channel(Phase::Open);
        let server = assemble(config, connections, phase).unwrap();
        let mut signals = Signals::catch().unwrap();
        server.registry.do_send(Panic);
        let ended = until_stopped(&mut signals, Path::new("none"), &server);
        let ended = actix_rt::time::timeout(Duration::from_secs(20), ended).await.unwrap();
        // Any error makes the program end with exit code 1.
        assert_eq!(ended.unwrap_err().to_string(), "the actor Registry is gone");
    }
}
