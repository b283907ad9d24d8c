//! The simulation server as a whole: its parts, its start and its shutdown.

use std::fs::File;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use actix::{Actor, Arbiter};
use actix_web::{App, web};
use prometheus::IntCounterVec;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::sync::{Mutex, watch};

use super::config::SimulationConfig;
use super::ends::Ends;
use super::handover::{ConnectionRouter, Inheritance, Predecessors, control};
use super::run_id::RunId;
use super::slots::SlotPool;
use super::snapshot::Holdings;
use super::spare_wishes::SpareWishes;
use super::state::AppState;
use super::upgrade::{Control, Estate};
use super::{announcer, readiness};
use crate::shared::config::load;
use crate::shared::domain::{AdmissionRules, FleetKey, Reason, ServerRun};
use crate::shared::http::server::{self, HttpServerOptions, Source};
use crate::shared::http::{
    AddressQuota, AdminAuth, AuthSettings, ConnectionLimiter, LiveUpdates, Metrics, STREAMS_PER_CLIENT, SharedPage,
    TCP_PER_CLIENT, open_door,
};
use crate::shared::run::start::CommonArgs;
use crate::shared::run::{
    AppError, Phase, ServerCommand, Signals, limit_clients, permanent, raise_open_files, service_manager, start,
};
use crate::simulation::checkout::{CacheDir, CheckoutService};
use crate::simulation::client::SpareKeeper;
use crate::simulation::container::ContainerService;
use crate::simulation::isolation::{DiskMonitor, Launcher};
use crate::simulation::machine::{LoadMonitor, Spread, UsageMonitor};
use crate::simulation::process::{Guardian, RunDir, is_alive, remove, runs_in};
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
    estate: Estate,
    /// What was taken over from the process before.
    inheritance: Option<Inheritance>,
    signals: Signals,
}

/// How a server begins.
pub enum Origin {
    /// It is started, and holds this PID file.
    Start(Option<File>),
    /// It takes over from another process.
    TakeOver(Inheritance),
}

impl Origin {
    /// Finds out what this process begins with.
    ///
    /// # Errors
    /// The exit code, if it can't begin.
    pub fn find(takes_over: bool, options: &CommonArgs) -> Result<Self, ExitCode> {
        if takes_over {
            return Inheritance::receive()
                .map(Self::TakeOver)
                .map_err(|why| start::failed(&why));
        }
        start::claim_pid_file(options).map(Self::Start)
    }
}

impl Application {
    /// Binds the port, starts the actors, and removes what earlier runs have left.
    ///
    /// # Errors
    /// When the server can't start. The process before has been told why.
    pub fn new(mut config: SimulationConfig, origin: Origin) -> Result<Self, AppError> {
        let signals = Signals::catch()?;
        config.max_clients = bound_clients(&config)?;
        let config = Arc::new(config);
        match origin {
            Origin::Start(pid_file) => {
                let listener = listen(&config)?;
                let (server, lock) = assemble(Arc::clone(&config), None)?;
                Ok(Self {
                    estate: Estate {
                        listener,
                        lock: Some(lock),
                        pid_file,
                        sign_in: server.sign_in.clone(),
                    },
                    server: Arc::new(server),
                    inheritance: None,
                    signals,
                })
            }
            Origin::TakeOver(mut inheritance) => {
                let assembled = assemble_successor(&config, &mut inheritance);
                let (server, estate) = assembled.inspect_err(|error| {
                    remove(&runs_in(&config.cache_dir.0).join(RunId::own().folder()));
                    inheritance.fail(&error.to_string());
                })?;
                Ok(Self {
                    server: Arc::new(server),
                    estate,
                    inheritance: Some(inheritance),
                    signals,
                })
            }
        }
    }
}

/// Creates the state of a server that takes over.
fn assemble_successor(
    config: &Arc<SimulationConfig>,
    inheritance: &mut Inheritance,
) -> Result<(AppState, Estate), AppError> {
    let listener = inheritance.listener.try_clone()?;
    if !listens_at(&listener, config) {
        return Err("port or bind has changed, which needs a stop and a start".into());
    }
    let (server, lock) = assemble(Arc::clone(config), Some(inheritance))?;
    if let Some(problem) = server.problem() {
        return Err(problem.into());
    }
    // Until the process before has told which it keeps.
    server.slots.set_others(Holdings {
        ports: config.streaming_ports().collect(),
        ..Holdings::default()
    });
    let estate = Estate {
        listener,
        lock: Some(lock),
        pid_file: inheritance.pid_file.take(),
        sign_in: inheritance.sign_in.clone(),
    };
    Ok((server, estate))
}

/// Listens on the port. If the process that had it has crashed, one before it has the socket.
fn listen(config: &SimulationConfig) -> Result<TcpListener, AppError> {
    let address = SocketAddr::new(config.bind, config.port);
    server::listen(address).or_else(|error| {
        let runs = std::fs::read_dir(runs_in(&config.cache_dir.0))
            .into_iter()
            .flatten()
            .flatten();
        let living = runs.map(|run| run.path()).filter(|run| is_alive(run));
        let mut passed = living.filter_map(|run| control::listener_of(&run).ok());
        let passed = passed.find(|listener| listens_at(listener, config));
        passed.ok_or_else(|| format!("can't listen on {address}: {error}").into())
    })
}

/// Whether a socket listens where this configuration says.
fn listens_at(listener: &TcpListener, config: &SimulationConfig) -> bool {
    let is_any = |address: IpAddr| address.is_unspecified() && config.bind.is_unspecified();
    listener
        .local_addr()
        .is_ok_and(|at| at.port() == config.port && (at.ip() == config.bind || is_any(at.ip())))
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
        estate,
        inheritance,
        mut signals,
    } = assembly;
    let cache = server.config.cache_dir.0.canonicalize()?;
    let owner = server.containers.as_ref().map(|containers| containers.run.0.as_str());
    let guardian = Guardian::start(server.run.path(), owner)?;
    let shared = web::Data::from(Arc::clone(&server));
    // They hold what comes before this process serves.
    let door = open_door(server.run.path())?;
    let socket = control::listen(server.run.path())?;
    begin(&server, (&cache, &estate), inheritance).await?;
    let has_moved = Arc::<AtomicBool>::default();
    let options = connection_options(&server, &cache, &has_moved);
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
    let door = server::serve(
        Source::Door(door),
        server.connections.clone(),
        options.clone(),
        app.clone(),
    )?;
    let door_handle = door.handle();
    actix_rt::spawn(door);
    let port = Source::Port(estate.listener.try_clone()?);
    let http = server::serve(port, server.connections.clone(), options, app)?;
    let handle = http.handle();
    let mut serving = actix_rt::spawn(http);
    let (orders, mut commands) = unbounded_channel();
    let control = Arc::new(Control {
        server: Arc::clone(&server),
        cache,
        port: handle.clone(),
        estate: Mutex::new(estate),
        has_moved,
        commands: orders,
    });
    let mut controlling = actix_rt::spawn(control.serve(socket));
    let config = &server.config;
    let port = config.port;
    start::announce(
        "simulation server",
        &config.http_url(),
        &format!("{}/client", config.websocket_url(port)),
        port,
    );
    let slots = Arc::clone(&server.slots);
    follow_slots(&slots, &server)?;
    let spare_keeper = SpareKeeper::new(Arc::clone(&server)).start();
    // This runs unless this thread is blocked, or another one holds the lock of the slots.
    // The service manager expects it of the process that has the port only.
    actix_rt::spawn(service_manager::feed_watchdog(async move || {
        slots.instances().slots > 0 && !slots.is_superseded()
    }));
    let why = tokio::select! {
        why = handle_signals((&mut signals, &mut commands), &server) => why,
        _ = &mut controlling => return Err("the socket for other processes has ended".into()),
        fault = permanent::stopped("LoadMonitor", server.load_monitor.clone()) => return Err(fault.into()),
        fault = permanent::stopped("SpareKeeper", spare_keeper) => return Err(fault.into()),
        ended = &mut serving => return Err(server::fault(ended).into()),
        never = guardian.watch() => match never {},
    };
    log::info!("stopping");
    if server.phase.send_replace(Phase::Closing) != Phase::Superseded {
        service_manager::stopping(why);
        server.predecessors.end();
    }
    if actix_rt::time::timeout(server.config.timing.stop, empty(&server))
        .await
        .is_err()
    {
        log::error!("some simulations have not ended in time: they are killed");
    }
    server.ends.flush().await;
    tokio::join!(handle.stop(true), door_handle.stop(true));
    drop(serving);
    server.run.remove();
    log::info!("stopped");
    Ok(())
}

fn connection_options(server: &AppState, cache: &Path, has_moved: &Arc<AtomicBool>) -> HttpServerOptions {
    HttpServerOptions {
        max_connections: max_tcp(&server.config),
        silence: server.config.timing.silence,
        stop: Duration::from_secs(1),
        trusted_proxies: server.config.trusted_proxies.clone(),
        router: Some(Arc::new(ConnectionRouter {
            cache: cache.to_owned(),
            predecessors: Arc::clone(&server.predecessors),
            slots: Arc::clone(&server.slots),
            has_moved: Arc::clone(has_moved),
        })),
    }
}

/// Becomes the process that has the port: at once, or as soon as the one before has handed it over.
async fn begin(
    server: &AppState,
    (cache, estate): (&Path, &Estate),
    inheritance: Option<Inheritance>,
) -> Result<(), AppError> {
    let predecessors = &server.predecessors;
    predecessors.look().await;
    if let Some(inheritance) = inheritance {
        let left = inheritance.take_over().await;
        let left = left.map_err(|error| format!("the process before has not handed over: {error}"))?;
        predecessors.told(inheritance.run, left);
        if let Some(file) = &estate.pid_file {
            start::write_pid(file)?;
        }
    } else {
        control::set_serving(cache, RunId::own())?;
    }
    predecessors.publish();
    let followed = Arc::clone(predecessors);
    keep_up("older processes", async move || Arc::clone(&followed).follow().await);
    Ok(())
}

/// Starts the tasks that look after slots: those that are reserved, and how fast simulations run.
fn follow_slots(slots: &Arc<SlotPool>, server: &AppState) -> Result<(), AppError> {
    let histogram = server.metrics.histogram(
        "webots_simulation_real_time_factor",
        "Simulated seconds per second of running simulations, every five seconds",
        &REAL_TIME_FACTORS,
    )?;
    let (checked, timed) = (Arc::clone(slots), Arc::clone(slots));
    keep_up("the check of slots", async move || Arc::clone(&checked).recheck().await);
    let target = server.config.real_time.target;
    keep_up("the times of simulations", async move || {
        Arc::clone(&timed).follow_real_time(target, histogram.clone()).await;
    });
    Ok(())
}

/// Runs a task in the background, and restarts it if it panics.
fn keep_up(name: &'static str, task: impl AsyncFnMut() + 'static) {
    actix_rt::spawn(async move { permanent::restarted(name, task).await });
}

/// Handles signals, and orders of other processes, until the server must stop. Returns the reason.
async fn handle_signals(
    (signals, orders): (&mut Signals, &mut UnboundedReceiver<ServerCommand>),
    server: &AppState,
) -> &'static str {
    loop {
        let command = tokio::select! {
            command = signals.next() => command,
            Some(command) = orders.recv() => command,
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

/// Creates the server's state, and starts its actors. Returns also the lock of `cacheDir`.
fn assemble(
    config: Arc<SimulationConfig>,
    inheritance: Option<&mut Inheritance>,
) -> Result<(AppState, File), AppError> {
    let secret = || hex::encode(rand::random::<[u8; 32]>());
    let sign_in = inheritance
        .as_ref()
        .map_or_else(secret, |before| before.sign_in.clone());
    let passed = inheritance.and_then(|before| before.lock.take());
    let cache_fault = |error| {
        format!(
            "the folder {} (cacheDir) can't be used: {error}",
            config.cache_dir.0.display()
        )
    };
    let CacheDir { folder: cache, lock } = CacheDir::claim(&config.cache_dir.0, passed).map_err(cache_fault)?;
    let (run, living) = RunDir::open(&cache).map_err(cache_fault)?;
    let launcher = Launcher::start(&config)?;
    let no_containers = |why| format!("isolation is \"container\", but {why}");
    let containers = config
        .docker
        .then(|| ContainerService::open(Arc::clone(&config), run.path(), &living));
    let containers = containers.transpose().map_err(no_containers)?.map(Arc::new);
    let rules = AdmissionRules {
        allowed: config.allowed_repositories.clone(),
        blocked: config.blocked_repositories.clone(),
        docker: config.docker,
        share_idle_time: config.share_idle_time,
    };
    let checkouts = CheckoutService::open(&cache, run.path(), Arc::clone(&config), rules.clone());
    let checkouts = checkouts.map_err(cache_fault)?;
    let metrics = Metrics::default();
    let logs = config.records();
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
    let predecessors = Predecessors::new(&cache, living, Arc::clone(&slots));
    let csv = config.monitor_log_enabled.then(|| config.records().join("monitor.csv"));
    let spread = Arc::new(Spread::over(config.displays_of_gpus().len()));
    let thread = || Arbiter::try_new().map(|thread| thread.handle());
    let (load_monitor, readings) = LoadMonitor::new(slots.clone(), run.path(), csv, spread.clone())?;
    let load_monitor = LoadMonitor::start_in_arbiter(&thread()?, |_| load_monitor);
    announcer::start(&config);
    let disk_monitor = DiskMonitor::start(run.path().to_owned(), config.disk_reserve)?;
    let starts = count_starts(&metrics)?;
    let fleet_key = config.fleet_key.as_ref().map(|key| FleetKey::new(key.reveal()));
    let server_run = ServerRun(RunId::number());
    let admin_auth = admin_auth(&config, (fleet_key.as_ref(), server_run), &sign_in);
    let spare_wishes = SpareWishes::default();
    spare_wishes.configure(config.ready.clone());
    let failed_starts = Arc::default();
    let problem = readiness::watch(
        Arc::clone(&config),
        run.path().to_owned(),
        readings.clone(),
        Arc::clone(&failed_starts),
    );
    let server = AppState {
        sign_in,
        predecessors: Arc::new(predecessors),
        rules,
        fleet_key,
        server_run,
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
    };
    Ok((server, lock))
}

/// Counts requests for simulations, by outcome.
fn count_starts(metrics: &Metrics) -> Result<IntCounterVec, AppError> {
    let starts = metrics.counter(
        "webots_simulation_starts_total",
        "Simulations that were asked for",
        "outcome",
    )?;
    starts.with_label_values(&["ready"]);
    for refusal in Reason::REFUSALS {
        starts.with_label_values(&[refusal.code()]);
    }
    Ok(starts)
}

/// Tells administrators from others. In a fleet without a key, `sign_in` is the secret for their sign-ins.
fn admin_auth(config: &SimulationConfig, (fleet_key, run): (Option<&FleetKey>, ServerRun), sign_in: &str) -> AdminAuth {
    AdminAuth::new(AuthSettings {
        password: config.admin_password.clone(),
        tokens: config.api_tokens.clone(),
        key: fleet_key.cloned().unwrap_or_else(|| FleetKey::new(sign_in)),
        has_fleet: fleet_key.is_some(),
        server_run: fleet_key.map(|_| run),
        port: config.port,
        ssl: config.ssl,
        trusted_proxies: config.trusted_proxies.clone(),
        user_header: config.user_header.clone(),
        home: "monitor",
    })
}

/// Waits until the server is draining, or another process has its port, and it has no simulation left.
async fn drained(server: &AppState) {
    server
        .phase
        .subscribe()
        .wait_for(|phase| matches!(phase, Phase::Draining | Phase::Superseded))
        .await
        .ok();
    empty(server).await;
}

/// Waits until there is no simulation, no slot is reserved, and the queue is empty; and the processes before this one have
/// ended, if it has the port.
async fn empty(server: &AppState) {
    while !(server.slots.is_empty() && (server.slots.is_superseded() || server.predecessors.is_empty())) {
        actix_rt::time::sleep(POLL_INTERVAL).await;
    }
}
