//! A simulation server that runs in this process.

use std::net::TcpListener;
use std::path::Path;
use std::sync::Arc;

use actix_rt::task::JoinHandle;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use webots_fleet::shared::config;
use webots_fleet::shared::http::ConnectionKind;
use webots_fleet::shared::run::AppError;
use webots_fleet::simulation::app::{self, Application};
use webots_fleet::simulation::config::SimulationConfig;
use webots_fleet::simulation::snapshot::Stage;
use webots_fleet::simulation::state::AppState;

use crate::support::client::Client;
use crate::support::git::Forge;
pub use crate::support::git::arm;
use crate::support::webots::{Webots, instances_below};
use crate::support::{ports, until};

/// A server with one place, and what it stands on. Its Webots is one of these scripts.
pub struct Inside {
    pub server: Arc<AppState>,
    pub port: u16,
    running: JoinHandle<Result<(), AppError>>,
    folder: tempfile::TempDir,
    _parts: (Forge, Webots, Option<TcpListener>),
}

const DEMO: &str =
    concat!("export DEMO_SIMULATOR_BIND=127.0.0.1; '", env!("CARGO_BIN_EXE_demo-simulator"), "' \"$@\" &\n");

/// The text of a Webots whose simulation comes to a certain state, and stays there. One that is to be stopping ignores
/// SIGTERM and has a child that hides.
pub fn webots_that_is(stage: Stage) -> String {
    match stage {
        Stage::Launching => "sleep 1000 & sleep 1000".to_owned(),
        Stage::Running => format!("{DEMO} echo real-time; wait"),
        Stage::Stopping => format!("trap '' TERM\n(setsid sleep 1000) &\n{DEMO} while true; do wait; sleep 0.1; done"),
        _ => format!("{DEMO} wait"),
    }
}

impl Inside {
    /// Starts a server. Where checkouts are to hang, its forge never answers.
    pub async fn new(stage: Stage, change: impl FnOnce(&mut SimulationConfig)) -> Self {
        // Before the server: it takes for its own what is started later.
        let (forge, webots) = (Forge::with_arm(), Webots::script(&webots_that_is(stage)));
        let (folder, port) = (tempfile::tempdir().unwrap(), ports::block(12));
        let hanging = (stage == Stage::CheckingOut).then(|| TcpListener::bind("127.0.0.1:0").unwrap());
        let mirror = match &hanging {
            Some(hanging) => format!("https://127.0.0.1:{}/", hanging.local_addr().unwrap().port()),
            None => format!("file:{}", forge.path().display()),
        };
        let file = folder.path().join("config.json");
        let text = serde_json::json!({
            "server": "localhost", "ssl": false, "portRewrite": false, "bind": "127.0.0.1", "port": port,
            "webots": webots.path(), "maxConnections": 1, "allowedRepositories": "https://github.com/lab",
            "gitMirrors": {"https://github.com/": mirror},
            "sandbox": {"readable": env!("CARGO_BIN_EXE_demo-simulator")},
            "logDir": folder.path().join("log"), "cacheDir": folder.path().join("cache"),
        });
        std::fs::write(&file, text.to_string()).unwrap();
        let mut config = config::load::<SimulationConfig>(&file).unwrap().config;
        change(&mut config);
        let assembly = Application::new(config).unwrap();
        let server = Arc::clone(&assembly.server);
        let running = actix_rt::spawn(app::serve(assembly));
        until("the server listens", async || std::net::TcpStream::connect(("127.0.0.1", port)).is_ok()).await;
        Self { server, port, running, folder, _parts: (forge, webots, hanging) }
    }

    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// A client that has asked for the world.
    pub async fn client(&self) -> Client {
        let mut client = self.connect().await;
        ask(&mut client).await;
        client
    }

    /// A client that has asked for nothing.
    pub async fn connect(&self) -> Client {
        Client::connect(&format!("ws://127.0.0.1:{}/client", self.port)).await
    }

    /// Waits until a simulation is in this state.
    pub async fn until(&self, stage: Stage) {
        let what = format!("a simulation is {stage:?}");
        until(&what, async || self.stages().contains(&stage)).await;
    }

    pub fn stages(&self) -> Vec<Stage> {
        self.server.slots.snapshot().simulations.iter().map(|one| one.stage).collect()
    }

    /// Waits until nothing of any simulation is left: connection, process, place, port and folder.
    pub async fn until_nothing_is_left(&self) {
        let runs = self.folder().join("cache/runs");
        let folders = || std::fs::read_dir(self.server.run.path()).unwrap().flatten();
        until("nothing is left", async || {
            self.stages().is_empty()
                && self.server.connections.count(ConnectionKind::Client) == 0
                && instances_below(&runs).is_empty()
                && !folders().any(|entry| entry.file_name().to_string_lossy().starts_with("instance-"))
                && TcpListener::bind(("0.0.0.0", self.port + 1)).is_ok()
        })
        .await;
    }

    /// How the server ends by itself.
    pub async fn ended(self) -> Result<(), AppError> {
        actix_rt::time::timeout(crate::support::SOON, self.running).await.unwrap().unwrap()
    }

    /// Stops the server.
    pub async fn stop(self) {
        let runs = self.folder().join("cache/runs");
        kill(Pid::this(), Signal::SIGTERM).unwrap();
        self.running.await.unwrap().unwrap();
        assert_eq!(std::fs::read_dir(runs).unwrap().count(), 0);
    }
}

/// Asks for the world.
pub async fn ask(client: &mut Client) {
    client.send(&serde_json::json!({"start": {"url": arm()}}).to_string()).await;
}
