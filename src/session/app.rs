//! The session server as a whole: what it is made of, how it starts, and how it ends.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use actix::prelude::*;
use actix_web::{App, HttpServer, web};
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use tokio::sync::{Semaphore, watch};

use super::audience::Audience;
use super::config::{SessionConfig, Timing};
use super::mailer;
use super::pick::{NoServer, Pick};
use super::registry::{Reconfigure, Registry};
use super::routes;
use crate::shared::config;
use crate::shared::metrics::Metrics;
use crate::shared::permanent;
use crate::shared::shutdown::{Phase, Request, Signals};

/// What routes and web clients share.
pub struct Server {
    /// Owns the fleet's state.
    pub registry: Addr<Registry>,
    /// Durations.
    pub timing: Timing,
    /// Whether URLs begin with `wss`.
    pub ssl: bool,
    /// Whether clients are taken.
    pub phase: watch::Receiver<Phase>,
    /// Counts WebSockets: each takes one.
    pub connections: Arc<Semaphore>,
    /// How many WebSockets may be open.
    pub max_clients: usize,
    /// What is counted.
    pub metrics: Metrics,
    /// Requests for a simulation server, by what came of them.
    pub picks: prometheus::IntCounterVec,
    /// When the server was started.
    pub started: Instant,
    /// The same, as a time of day.
    pub started_at: SystemTime,
}

/// The answer to a request for a simulation server.
pub struct Answer {
    /// A URL, or `Error: ...`.
    pub text: String,
    /// Why there is no URL.
    pub refusal: Option<NoServer>,
}

/// Why the server can't go on.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The port is taken, or may not be used.
    #[error("can't listen on {address}: {source}")]
    Bind {
        /// Host and port.
        address: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// Something else in the system.
    #[error(transparent)]
    System(#[from] std::io::Error),
    /// A name of a metric is wrong.
    #[error(transparent)]
    Metrics(#[from] prometheus::Error),
    /// A fault in this program.
    #[error("{0}")]
    Gone(String),
}

/// How long the registry may take to pick a server.
const PATIENCE: Duration = Duration::from_secs(2);
/// What can come of a request: each is counted from the start.
const OUTCOMES: [&str; 4] = ["placed", "unavailable", "not_accepted", "wrong_url"];

impl Server {
    /// How many web clients are connected.
    #[must_use]
    pub fn clients(&self) -> usize {
        self.max_clients.saturating_sub(self.connections.available_permits())
    }

    /// Asks for a simulation server, and puts the answer in the words of the protocol.
    pub async fn pick(&self, wanted: Result<Pick, NoServer>) -> Answer {
        let picked = match wanted {
            Ok(pick) => {
                let picked = actix_rt::time::timeout(PATIENCE, self.registry.send(pick)).await;
                picked.ok().and_then(Result::ok).unwrap_or(Err(NoServer::Unavailable))
            }
            Err(wrong) => Err(wrong),
        };
        let outcome = match &picked {
            Ok(_) => "placed",
            Err(NoServer::Unavailable) => "unavailable",
            Err(NoServer::NotAccepted(_)) => "not_accepted",
            Err(NoServer::NoWorld(_)) => "wrong_url",
        };
        self.picks.with_label_values(&[outcome]).inc();
        match picked {
            Ok(address) => Answer { text: address.websocket_url(self.ssl), refusal: None },
            Err(refusal) => Answer { text: refusal.to_string(), refusal: Some(refusal) },
        }
    }
}

/// Runs the server until it is asked to stop. `file` is read again on SIGHUP.
///
/// # Errors
/// When it can't start, or an actor that must live is gone.
pub async fn run(mut config: SessionConfig, file: PathBuf) -> Result<(), AppError> {
    let mut signals = Signals::catch()?;
    allow_open_files();
    let (phase_sender, phase) = watch::channel(Phase::Open);
    let address = format!("{}:{}", config.bind, config.port);
    let socket = std::net::TcpListener::bind(&address).map_err(|source| AppError::Bind { address, source })?;
    let port = socket.local_addr()?.port();
    config.port = port;
    let stop = config.timing.stop;
    let told = config.address().http_url(config.ssl);
    let server = Arc::new(assemble(config, phase)?);
    let shared = web::Data::from(Arc::clone(&server));
    // This is called in each thread that serves connections.
    let app = move || {
        let audience = Audience::new(Arc::clone(&shared)).start();
        App::new().app_data(shared.clone()).app_data(web::Data::new(audience)).configure(routes::configure)
    };
    let http =
        HttpServer::new(app).disable_signals().shutdown_timeout(stop.as_secs()).backlog(4096).listen(socket)?.run();
    let handle = http.handle();
    let serving = actix_rt::spawn(http);
    log::info!("session server {} listens on port {port}: {told}", env!("CARGO_PKG_VERSION"));
    println!("session server: {told}/monitor (local port {port})");
    let mut lost = std::pin::pin!(permanent::gone("Registry", server.registry.clone()));
    loop {
        let request = tokio::select! {
            request = signals.next() => request,
            name = &mut lost => return Err(AppError::Gone(name)),
        };
        match request {
            Request::Stop => break,
            Request::Reload => reload(&file, &server.registry),
            Request::Drain => log::info!("SIGUSR1 changes nothing here: simulation servers are drained"),
        }
    }
    log::info!("stopping");
    phase_sender.send_replace(Phase::Closing);
    // A connection that doesn't end in time is cut.
    actix_rt::time::timeout(stop, handle.stop(true)).await.ok();
    drop(serving);
    log::info!("stopped");
    Ok(())
}

/// Lets the server open as many files as the system allows it: each client is one, and the usual limit is 1,024.
fn allow_open_files() {
    let raised = getrlimit(Resource::RLIMIT_NOFILE)
        .and_then(|(_, most)| setrlimit(Resource::RLIMIT_NOFILE, most, most).map(|()| most));
    match raised {
        Ok(most) => log::debug!("{most} files may be open"),
        Err(error) => log::warn!("the limit of open files can't be raised: {error}"),
    }
}

/// Makes everything that the server is made of, and starts its actors.
fn assemble(config: SessionConfig, phase: watch::Receiver<Phase>) -> Result<Server, AppError> {
    let metrics = Metrics::new();
    let latencies = metrics.histogram("session_report_seconds", "Time in which simulation servers answer")?;
    let picks = metrics.counter("session_requests_total", "Requests for a simulation server", "outcome")?;
    for outcome in OUTCOMES {
        picks.with_label_values(&[outcome]).reset();
    }
    let notices = mailer::start(&config).map(Addr::recipient);
    let (timing, ssl) = (config.timing.clone(), config.ssl);
    let max_clients = config.max_clients;
    let connections = Arc::new(Semaphore::new(max_clients));
    let registry = Registry::new(Arc::new(config), notices, latencies).start();
    let (started, started_at) = (Instant::now(), SystemTime::now());
    Ok(Server { registry, timing, ssl, phase, connections, max_clients, metrics, picks, started, started_at })
}

/// Reads the configuration again. One that can't be used changes nothing.
fn reload(file: &Path, registry: &Addr<Registry>) {
    match config::load::<SessionConfig>(file) {
        Ok(loaded) => {
            for warning in &loaded.warnings {
                log::warn!("{warning}");
            }
            log::info!("read {} again: {} simulation servers", file.display(), loaded.config.simulation_servers.len());
            registry.do_send(Reconfigure(Arc::new(loaded.config)));
        }
        Err(error) => log::error!("the configuration stays as it was: {error}"),
    }
}
