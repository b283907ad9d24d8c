//! A simulation server that runs in this process.

use std::net::TcpListener;
use std::sync::Arc;

use actix_rt::task::JoinHandle;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use webots_fleet::shared::config;
use webots_fleet::shared::domain::Stage;
use webots_fleet::shared::http::ConnectionKind;
use webots_fleet::shared::run::AppError;
use webots_fleet::simulation::app::{self, Application, Origin};
use webots_fleet::simulation::config::SimulationConfig;
use webots_fleet::simulation::state::AppState;

use crate::support::{Builder, Client, arm, instance_folders_in, instances_below, server_that_is, until};

/// A server with one slot, and what it needs.
pub struct Inside {
    pub server: Arc<AppState>,
    pub port: u16,
    running: JoinHandle<Result<(), AppError>>,
    folder: tempfile::TempDir,
    _parts: (Builder, Option<TcpListener>),
}

impl Inside {
    /// Starts a server. If checkouts are to hang, its forge never answers.
    pub async fn new(stage: Stage, change: impl FnOnce(&mut SimulationConfig)) -> Self {
        // Before the server starts: it would take processes that are started later for its own.
        let (mut builder, hanging) = server_that_is(&format!("{stage:?}").to_lowercase());
        let folder = tempfile::tempdir().unwrap();
        let mut config = config::load::<SimulationConfig>(&builder.write(folder.path()))
            .unwrap()
            .config;
        change(&mut config);
        let port = config.port;
        let assembly = Application::new(config, Origin::Start(None)).unwrap();
        let server = Arc::clone(&assembly.server);
        let running = actix_rt::spawn(app::serve(assembly));
        until("the server listens", async || {
            std::net::TcpStream::connect(("127.0.0.1", port)).is_ok()
        })
        .await;
        Self {
            server,
            port,
            running,
            folder,
            _parts: (builder, hanging),
        }
    }

    /// A client that has requested the world.
    pub async fn client(&self) -> Client {
        self.connect().await.asking(&arm()).await
    }

    /// A client that has requested nothing.
    pub async fn connect(&self) -> Client {
        Client::connect(&format!("ws://127.0.0.1:{}/client", self.port)).await
    }

    /// Waits until a simulation is in this state.
    pub async fn until(&self, stage: Stage) {
        let what = format!("a simulation is {stage:?}");
        until(&what, async || self.stages().contains(&stage)).await;
    }

    pub fn stages(&self) -> Vec<Stage> {
        self.server
            .slots
            .snapshot()
            .simulations
            .iter()
            .map(|one| one.stage)
            .collect()
    }

    /// Waits until nothing of any simulation remains: connection, process, slot, port and folder.
    pub async fn until_nothing_is_left(&self) {
        let cache = self.folder.path().join("cache");
        until("nothing is left", async || {
            self.stages().is_empty()
                && self.server.connections.count(ConnectionKind::Client) == 0
                && instances_below(&cache).is_empty()
                && instance_folders_in(&cache).is_empty()
                && TcpListener::bind(("0.0.0.0", self.port + 1)).is_ok()
        })
        .await;
    }

    /// Waits until the server ends by itself; returns its result.
    pub async fn ended(self) -> Result<(), AppError> {
        actix_rt::time::timeout(crate::support::SOON, self.running)
            .await
            .unwrap()
            .unwrap()
    }

    /// Stops the server.
    pub async fn stop(self) {
        kill(Pid::this(), Signal::SIGTERM).unwrap();
        self.running.await.unwrap().unwrap();
        assert_eq!(
            std::fs::read_dir(self.folder.path().join("cache/runs"))
                .unwrap()
                .count(),
            0
        );
    }
}
