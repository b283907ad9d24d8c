//! The simulation server as a whole: its parts, its start and its shutdown.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::{Actor, Arbiter};
use actix_web::{App, web};
use tokio::sync::watch;

use super::config::SimulationConfig;
use super::ends::Ends;
use super::slots::SlotPool;
use super::snapshot::Snapshot;
use super::spare_wishes::SpareWishes;
use super::state::AppState;
use super::{announcer, readiness};
use crate::shared::config::load;
use crate::shared::domain::{AdmissionRules, FleetKey, Reason, ServerRun};
use crate::shared::http::server::{self, HttpServerOptions};
use crate::shared::http::{
    AddressQuota, AdminAuth, AuthSettings, ConnectionLimiter, LiveUpdates, Metrics, STREAMS_PER_CLIENT, SharedPage,
    TCP_PER_CLIENT,
};
use crate::shared::run::{
    AppError, Phase, ServerCommand, Signals, limit_clients, permanent, raise_open_files, service_manager, start,
};
use crate::simulation::checkout::{CacheDir, CheckoutService};
use crate::simulation::client::SpareKeeper;
use crate::simulation::container::ContainerService;
use crate::simulation::isolation::{DiskMonitor, Launcher};
use crate::simulation::machine::{LoadMonitor, Spread, UsageMonitor};
use crate::simulation::process::{Guardian, RunDir};
use crate::simulation::relay::{StreamThread, Upstream};
use crate::simulation::web::configure;

/// Interval between two checks whether all simulations have ended.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Open files that the server itself needs: logs, threads, pages.
const OWN_FILES: usize = 128;

/// Largest number of open files of a simulation, besides its client's connection: pipes and processes of git and
/// Webots, its log.
const FILES_PER_SIMULATION: usize = 8;

/// The upper bounds of real-time factors in the metric.
const REAL_TIME_FACTORS: [f64; 9] = [0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 1.05, 2.0, 5.0];

/// A server that is ready to serve: its port is bound, and its actors run.
pub struct Application {
    /// The state that routes and web clients share.
    pub server: Arc<AppState>,
    socket: TcpListener,
    signals: Signals,
}

impl Application {
    /// Binds the port, starts the actors, and removes what earlier runs have left.
    ///
    /// # Errors
    /// When the server can't start.
    pub fn new(mut config: SimulationConfig) -> Result<Self, AppError> {
        let signals = Signals::catch()?;
        config.max_clients = bound_clients(&config)?;
        let address = SocketAddr::new(config.bind, config.port);
        let socket = server::listen(address).map_err(|error| format!("can't listen on {address}: {error}"))?;
        Ok(Self {
            server: Arc::new(assemble(Arc::new(config))?),
            socket,
            signals,
        })
    }
}

/// Raises the limit of open files. Returns the number of clients that it allows, at most `maxClients`: each client has
/// connections for pages and streams besides its WebSocket.
fn bound_clients(config: &SimulationConfig) -> Result<usize, String> {
    let places = config.max_connections;
    let needed = OWN_FILES + FILES_PER_SIMULATION * usize::from(places);
    // Each relayed stream or file has two connections: to its client and to Webots.
    let each = TCP_PER_CLIENT + 2 * streams_per_client(config);
    let wanted = config.max_clients.saturating_mul(each).saturating_add(needed);
    let files = raise_open_files(u64::try_from(wanted).unwrap_or(u64::MAX));
    let rest = usize::try_from(files).unwrap_or(usize::MAX).saturating_sub(needed);
    limit_clients(
        files,
        rest / each,
        config.max_clients,
        &format!("{places} places and one client"),
    )
}

/// Runs a server until a signal or an administrator stops it.
///
/// # Errors
/// When the `LoadMonitor` has stopped, or the system refuses what the server needs.
pub async fn serve(assembly: Application) -> Result<(), AppError> {
    let Application {
        server,
        socket,
        mut signals,
    } = assembly;
    let owner = server.containers.as_ref().map(|containers| containers.run.0.as_str());
    let guardian = Guardian::start(server.run.path(), owner)?;
    let shared = web::Data::from(Arc::clone(&server));
    let options = HttpServerOptions {
        max_connections: max_tcp(&server.config),
        silence: server.config.timing.silence,
        stop: Duration::from_secs(1),
        trusted_proxies: server.config.trusted_proxies.clone(),
    };
    let simulations = server
        .launcher
        .reached()
        .unwrap_or_else(|| server.config.address_of_simulations());
    let stream_thread = StreamThread::start(options.silence)?;
    let silence = options.silence;
    let answer = server.config.timing.answer;
    let auth = web::Data::from(Arc::clone(&server.admin_auth));
    let app = move || {
        let upstream = Upstream::new(simulations, stream_thread.clone(), silence, answer);
        App::new()
            .app_data(shared.clone())
            .app_data(auth.clone())
            .app_data(upstream)
            .configure(configure)
    };
    let http = server::serve(socket, server.connections.clone(), options, app)?;
    let handle = http.handle();
    let mut serving = actix_rt::spawn(http);
    let config = &server.config;
    let port = config.port;
    start::announce(
        "simulation server",
        &config.http_url(),
        &format!("{}/client", config.websocket_url(port)),
        port,
    );
    let slots = Arc::clone(&server.slots);
    actix_rt::spawn(Arc::clone(&slots).recheck());
    let histogram = server.metrics.histogram(
        "webots_simulation_real_time_factor",
        "Simulated seconds per second of running simulations, every five seconds",
        &REAL_TIME_FACTORS,
    )?;
    actix_rt::spawn(Arc::clone(&slots).follow_real_time(config.real_time.target, histogram));
    let spare_keeper = SpareKeeper::new(Arc::clone(&server)).start();
    // This runs unless this thread is blocked, or another one holds the lock of the slots.
    actix_rt::spawn(service_manager::feed_watchdog(async move || {
        slots.instances().slots > 0
    }));
    let why = tokio::select! {
        why = handle_signals(&mut signals, &server) => why,
        fault = permanent::stopped("LoadMonitor", server.load_monitor.clone()) => return Err(fault.into()),
        fault = permanent::stopped("SpareKeeper", spare_keeper) => return Err(fault.into()),
        ended = &mut serving => return Err(server::fault(ended).into()),
        never = guardian.watch() => match never {},
    };
    log::info!("stopping");
    service_manager::stopping(why);
    server.phase.send_replace(Phase::Closing);
    if actix_rt::time::timeout(server.config.timing.stop, empty(&server))
        .await
        .is_err()
    {
        log::error!("some simulations have not ended in time: they are killed");
    }
    server.ends.flush().await;
    handle.stop(true).await;
    drop(serving);
    server.run.remove();
    log::info!("stopped");
    Ok(())
}

/// Handles signals until the server must stop. Returns the reason: `webots-fleet-renew` decides by this text whether a
/// server was drained or stopped.
async fn handle_signals(signals: &mut Signals, server: &AppState) -> &'static str {
    loop {
        let command = tokio::select! {
            command = signals.next() => command,
            () = drained(server) => return "drained: its last simulation has ended",
        };
        match command {
            ServerCommand::Stop => return "stopping",
            ServerCommand::Drain => server.drain(),
            ServerCommand::Reload => reload(server),
        }
    }
}

/// Reads the key `ready` again. All others are read at start only.
fn reload(server: &AppState) {
    match load::<SimulationConfig>(&server.config.file) {
        Ok(loaded) => {
            server.spare_wishes.configure(loaded.config.ready);
            log::info!("the key ready was read again; all others are read at start");
        }
        Err(error) => log::error!("the configuration was not read again: {error}"),
    }
}

/// Limit of TCP connections: those of clients, the same number for pages and other requests, and what is relayed.
fn max_tcp(config: &SimulationConfig) -> usize {
    config
        .max_clients
        .saturating_mul(TCP_PER_CLIENT + streams_per_client(config))
}

fn streams_per_client(config: &SimulationConfig) -> usize {
    if config.ports_are_public() {
        0
    } else {
        STREAMS_PER_CLIENT
    }
}

/// Creates the server's state, and starts its actors.
fn assemble(config: Arc<SimulationConfig>) -> Result<AppState, AppError> {
    let folder = config.cache_dir.0.clone();
    let cache_fault = |error| format!("the folder {} (cacheDir) can't be used: {error}", folder.display());
    let cache_dir = CacheDir::claim(&folder).map_err(cache_fault)?;
    let run = RunDir::open(&folder).map_err(cache_fault)?;
    let launcher = Launcher::start(&config)?;
    let no_containers = |why| format!("isolation is \"container\", but {why}");
    let containers = config
        .docker
        .then(|| ContainerService::open(Arc::clone(&config), run.path()));
    let containers = containers.transpose().map_err(no_containers)?.map(Arc::new);
    let rules = AdmissionRules {
        allowed: config.allowed_repositories.clone(),
        blocked: config.blocked_repositories.clone(),
        docker: config.docker,
        share_idle_time: config.share_idle_time,
    };
    let checkouts = CheckoutService::open(cache_dir, run.path(), Arc::clone(&config), rules.clone());
    let checkouts = checkouts.map_err(cache_fault)?;
    let metrics = Metrics::default();
    let logs = config.log_dir.0.join("simulation");
    let ends = Ends::start(logs, launcher.level().to_string(), config.record_months, &metrics)?;
    let slots = SlotPool::new(
        config.streaming_ports(),
        config.waiting_line,
        config.max_places_per_address,
        config.max_places_per_user,
        config.timing.yield_after,
        config.timing.pass,
        ends.clone(),
    );
    let csv = config
        .monitor_log_enabled
        .then(|| config.log_dir.0.join("simulation/monitor.csv"));
    let spread = Arc::new(Spread::over(config.displays_of_gpus().len()));
    let thread = || Arbiter::try_new().map(|thread| thread.handle());
    let (load_monitor, readings) = LoadMonitor::new(slots.clone(), run.path(), csv, spread.clone())?;
    let load_monitor = LoadMonitor::start_in_arbiter(&thread()?, |_| load_monitor);
    announcer::start(&config);
    let disk_monitor = DiskMonitor::start(run.path().to_owned(), config.disk_reserve)?;
    let starts = metrics.counter(
        "webots_simulation_starts_total",
        "Simulations that were asked for",
        "outcome",
    )?;
    starts.with_label_values(&["ready"]);
    for refusal in Reason::REFUSALS {
        starts.with_label_values(&[refusal.code()]);
    }
    let fleet_key = config.fleet_key.as_ref().map(|key| FleetKey::new(key.reveal()));
    let admin_auth = admin_auth(&config, fleet_key.as_ref());
    let spare_wishes = SpareWishes::default();
    spare_wishes.configure(config.ready.clone());
    let failed_starts = Arc::default();
    let problem = readiness::watch(
        Arc::clone(&config),
        run.path().to_owned(),
        readings.clone(),
        Arc::clone(&failed_starts),
    );
    Ok(AppState {
        rules,
        fleet_key,
        server_run: ServerRun(rand::random()),
        problem,
        failed_starts,
        ends,
        slots,
        spare_wishes,
        sessions: Arc::default(),
        load_monitor,
        readings,
        spread: config.spreads().then_some(spread),
        checkouts: Arc::new(checkouts),
        launcher: Arc::new(launcher),
        containers,
        run: Arc::new(run),
        phase: watch::Sender::new(Phase::Open),
        webots_threads: [thread()?, thread()?, thread()?, thread()?],
        admin_auth: Arc::new(admin_auth),
        connections: ConnectionLimiter::new(max_tcp(&config), config.max_clients, config.max_clients_per_address),
        metrics,
        starts,
        // Each start costs a checkout and a Webots. The quota lets a class take all slots, and then reload its pages.
        start_quota: AddressQuota::new(200.max(2 * u32::from(config.max_connections)), 60),
        monitor: SharedPage::default(),
        live: LiveUpdates::default(),
        administrators: LiveUpdates::default(),
        usage: UsageMonitor::default(),
        class_page: watch::Sender::default(),
        disk_monitor,
        started: Instant::now(),
        config,
    })
}

/// Tells administrators from others.
fn admin_auth(config: &SimulationConfig, fleet_key: Option<&FleetKey>) -> AdminAuth {
    AdminAuth::new(AuthSettings {
        password: config.admin_password.clone(),
        tokens: config.api_tokens.clone(),
        key: fleet_key.cloned().unwrap_or_else(FleetKey::random),
        has_fleet: fleet_key.is_some(),
        port: config.port,
        ssl: config.ssl,
        trusted_proxies: config.trusted_proxies.clone(),
        user_header: config.user_header.clone(),
        home: "monitor",
    })
}

/// Waits until the server is draining and has no simulation left.
async fn drained(server: &AppState) {
    server
        .phase
        .subscribe()
        .wait_for(|phase| *phase == Phase::Draining)
        .await
        .ok();
    empty(server).await;
}

/// Waits until there is no simulation, no slot is reserved, and the queue is empty.
async fn empty(server: &AppState) {
    let is_empty = |all: &Snapshot| all.simulations.is_empty() && all.spares == 0 && all.instances.reserved == 0;
    while !is_empty(&server.slots.snapshot()) {
        actix_rt::time::sleep(POLL_INTERVAL).await;
    }
}
