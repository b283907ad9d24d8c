//! A server in which one client has come to a certain state of its simulation.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::support::client::Client;
use crate::support::git::Forge;
pub use crate::support::git::arm;
use crate::support::program::{Builder, Server, simulation_server};
use crate::support::until;
use crate::support::webots::{Webots, instance_folders_in, instances_below};

pub const DEMO: &str = concat!("'", env!("CARGO_BIN_EXE_demo-simulator"), "'");

/// The states of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    Connected,
    Waiting,
    CheckingOut,
    Launching,
    Idle,
    Running,
    Stopping,
}

pub const ALL: [State; 7] = [
    State::Connected,
    State::Waiting,
    State::CheckingOut,
    State::Launching,
    State::Idle,
    State::Running,
    State::Stopping,
];

/// Everything of a test in one state. The server ends with it.
pub struct Scene {
    pub server: Server,
    /// The client in that state; it has left where the state is `Stopping`.
    pub client: Option<Client>,
    /// When it began to leave, if it has.
    pub left: Option<Instant>,
    /// The one that holds the only place, where the state is `Waiting`.
    pub other: Option<Client>,
    pub folder: tempfile::TempDir,
    _parts: (Forge, Webots, Option<TcpListener>),
}

impl Scene {
    /// Brings a client into this state.
    pub async fn new(state: State, change: impl FnOnce(Builder) -> Builder) -> Self {
        let (forge, folder) = (Forge::with_arm(), tempfile::tempdir().unwrap());
        let webots = Webots::script(&match state {
            State::Launching => "sleep 1000 & sleep 1000".to_owned(),
            State::Running => format!("{DEMO} \"$@\" & echo real-time; wait"),
            State::Stopping => {
                format!("trap '' TERM\n(setsid sleep 1000) &\n{DEMO} \"$@\" &\nwhile true; do wait; sleep 0.1; done")
            }
            _ => format!("{DEMO} \"$@\" & wait"),
        });
        let mut builder = simulation_server(&webots.path(), forge.path(), 1).folder(folder.path());
        let hanging = (state == State::CheckingOut).then(|| TcpListener::bind("127.0.0.1:0").unwrap());
        if let Some(hanging) = &hanging {
            let mirror = format!("https://127.0.0.1:{}/", hanging.local_addr().unwrap().port());
            builder = builder.set("gitMirrors", serde_json::json!({"https://github.com/": mirror}));
        }
        let server = change(builder).start().await;
        let mut other = None;
        if state == State::Waiting {
            let first = Client::ready(&server).await;
            other = Some(first);
        }
        let client = Client::connect(&server.websocket("/client")).await;
        let _parts = (forge, webots, hanging);
        let mut scene = Self { server, client: Some(client), left: None, other, folder, _parts };
        scene.come_to(state).await;
        scene
    }

    async fn come_to(&mut self, state: State) {
        let client = self.client.as_mut().unwrap();
        if state != State::Connected {
            client.send(&serde_json::json!({"start": {"url": arm()}}).to_string()).await;
        }
        match state {
            State::Connected => {}
            State::Waiting => assert_eq!(client.until("queue:").await, "queue: 0"),
            State::CheckingOut => {
                client.until("loading: Step 1/9 : looking for").await;
                let folder = self.folder.path();
                until("git runs", async || instances_below(folder).iter().any(|one| one.1.contains("ls-remote"))).await;
            }
            State::Launching => drop(client.until("shutdownTimeout").await),
            State::Idle | State::Running | State::Stopping => drop(client.until("webots:").await),
        }
        if state == State::Stopping {
            self.left = Some(Instant::now());
            self.client.take().unwrap().leave().await;
        }
        let shown = match state {
            State::Connected => return,
            State::Waiting => "queued",
            State::CheckingOut => "checkingout",
            State::Launching => "launching",
            State::Idle => "idle",
            State::Running => "running",
            State::Stopping => "stopping",
        };
        let server = &self.server;
        until(shown, async || stages(server).await.iter().any(|stage| stage == shown)).await;
    }
}

/// The states of all simulations, as the server shows them.
pub async fn stages(server: &Server) -> Vec<String> {
    let status = server.status().await;
    status["simulations"].as_array().unwrap().iter().map(|one| one["stage"].as_str().unwrap().to_owned()).collect()
}

/// Waits until nothing of any simulation is left: process, place, port and folder.
pub async fn nothing_left(server: &Server, places: u16) {
    until("all simulations are gone", async || {
        stages(server).await.is_empty()
            && instances_below(&server.folder).is_empty()
            && instance_folders(&server.folder).is_empty()
            && (server.port + 1..=server.port + places).all(|port| TcpListener::bind(("0.0.0.0", port)).is_ok())
    })
    .await;
}

/// Waits until nothing of a simulation is left on a server with one place, which is to be so soon after its grace time, in
/// seconds, since its client has left. Returns how long it took.
pub async fn gone_within(grace: f64, left: Instant, server: &Server) -> Duration {
    nothing_left(server, 1).await;
    let took = left.elapsed();
    assert!(took < Duration::from_secs_f64(grace + 5.0), "it took {took:?}, and the grace time is {grace} s");
    took
}

/// The folders of simulations below a server's folder.
pub fn instance_folders(folder: &Path) -> Vec<PathBuf> {
    instance_folders_in(&folder.join("cache"))
}
