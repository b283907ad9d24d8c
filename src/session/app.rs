//! The session server as a whole: what it is made of, how it starts, and how it ends.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use actix::prelude::*;
use actix_web::{App, HttpServer, web};
use tokio::sync::{Semaphore, watch};

use super::config::{SessionConfig, Timing};
use super::mailer;
use super::registry::{IsAvailable, NoServer, Pick, Reconfigure, Registry};
use super::routes;
use crate::shared::config;
use crate::shared::metrics::Metrics;
use crate::shared::notify;
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
    /// Counts WebSockets.
    pub connections: Arc<Semaphore>,
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

impl Server {
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
pub async fn run(config: SessionConfig, file: PathBuf) -> Result<(), AppError> {
    let mut signals = Signals::catch()?;
    let (phase_sender, phase) = watch::channel(Phase::Open);
    let address = format!("{}:{}", config.bind, config.port);
    let socket = std::net::TcpListener::bind(&address).map_err(|source| AppError::Bind { address, source })?;
    let port = socket.local_addr()?.port();
    let stop = config.timing.stop;
    let told = config.address().http_url(config.ssl);
    let server = Arc::new(assemble(config, phase)?);
    let shared = web::Data::from(Arc::clone(&server));
    let http = HttpServer::new(move || App::new().app_data(shared.clone()).configure(routes::configure))
        .disable_signals()
        .shutdown_timeout(stop.as_secs())
        .backlog(4096)
        .listen(socket)?
        .run();
    let handle = http.handle();
    let serving = actix_rt::spawn(http);
    log::info!("session server {} listens on port {port}: {told}", env!("CARGO_PKG_VERSION"));
    println!("session server: {told}/monitor (local port {port})");
    let listening = format!("listens on port {port}");
    notify::ready(&listening);
    let registry = server.registry.clone();
    actix_rt::spawn(notify::feed_watchdog(async move || registry.send(IsAvailable).await.is_ok()));
    let mut lost = std::pin::pin!(permanent::gone("Registry", server.registry.clone()));
    loop {
        let request = tokio::select! {
            request = signals.next() => request,
            name = &mut lost => return Err(AppError::Gone(name)),
        };
        match request {
            Request::Stop => break,
            Request::Reload => {
                notify::reloading();
                reload(&file, &server.registry);
                notify::ready(&listening);
            }
            Request::Drain => log::info!("SIGUSR1 changes nothing here: simulation servers are drained"),
        }
    }
    log::info!("stopping");
    notify::stopping();
    phase_sender.send_replace(Phase::Closing);
    // A connection that doesn't end in time is cut.
    actix_rt::time::timeout(stop, handle.stop(true)).await.ok();
    drop(serving);
    log::info!("stopped");
    Ok(())
}

/// Makes everything that the server is made of, and starts its actors.
fn assemble(config: SessionConfig, phase: watch::Receiver<Phase>) -> Result<Server, AppError> {
    let metrics = Metrics::new();
    let latencies = metrics.histogram("session_report_seconds", "Time in which simulation servers answer")?;
    let picks = metrics.counter("session_requests_total", "Requests for a simulation server", "outcome")?;
    let notices = mailer::start(&config).map(Addr::recipient);
    let (timing, ssl) = (config.timing.clone(), config.ssl);
    let connections = Arc::new(Semaphore::new(config.max_clients));
    let registry = Registry::new(Arc::new(config), notices, latencies).start();
    let (started, started_at) = (Instant::now(), SystemTime::now());
    Ok(Server { registry, timing, ssl, phase, connections, metrics, picks, started, started_at })
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
