//! A server with one client in a certain state.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::support::{Builder, Client, Server, arm, instance_folders_in, instances_below, server_that_is, until};

/// The states: connected without a simulation, and the states of simulations that servers show.
pub const ALL: [&str; 7] = [
    "connected",
    "queued",
    "checkingout",
    "launching",
    "idle",
    "running",
    "stopping",
];

/// A server and its clients in one state. The server ends with this value.
pub struct Scene {
    pub server: Server,
    /// The client in that state; in `stopping` it has left.
    pub client: Option<Client>,
    /// In `queued`, the client that has the only slot.
    pub other: Option<Client>,
    pub folder: tempfile::TempDir,
    _hanging: Option<TcpListener>,
}

impl Scene {
    /// Brings a client into this state.
    pub async fn new(state: &str, change: impl FnOnce(Builder) -> Builder) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (builder, hanging) = server_that_is(state);
        let builder = builder.folder(folder.path());
        let server = change(builder).start().await;
        let other = if state == "queued" {
            Some(Client::ready(&server).await)
        } else {
            None
        };
        let client = Client::connect(&server.websocket("/client")).await;
        if state == "connected" {
            return Self {
                server,
                client: Some(client),
                other,
                folder,
                _hanging: hanging,
            };
        }
        let mut client = client.asking(&arm()).await;
        let told = match state {
            "queued" => "queue: 0",
            "checkingout" => "loading: Step 1/9 : looking for",
            "launching" => "shutdownTimeout",
            _ => "webots:",
        };
        client.until(told).await;
        if state == "checkingout" {
            let runs = || {
                instances_below(folder.path())
                    .iter()
                    .any(|one| one.1.contains("ls-remote"))
            };
            until("git runs", async || runs()).await;
        }
        let mut client = Some(client);
        if state == "stopping" {
            client.take().unwrap().leave().await;
        }
        until(state, async || stages(&server).await.iter().any(|stage| stage == state)).await;
        Self {
            server,
            client,
            other,
            folder,
            _hanging: hanging,
        }
    }
}

pub async fn stages(server: &Server) -> Vec<String> {
    let status = server.status().await;
    status["simulations"]
        .as_array()
        .unwrap()
        .iter()
        .map(|one| one["stage"].as_str().unwrap().to_owned())
        .collect()
}

/// Waits until nothing of any simulation remains: process, slot, port and folder.
pub async fn nothing_left(server: &Server, places: u16) {
    until("all simulations are gone", async || {
        // The most expensive check comes last: it reads all processes of the machine.
        stages(server).await.is_empty()
            && instance_folders(&server.folder).is_empty()
            && (server.port + 1..=server.port + places).all(|port| TcpListener::bind(("0.0.0.0", port)).is_ok())
            && instances_below(&server.folder).is_empty()
    })
    .await;
}

/// Waits until nothing of a simulation remains on a server with one slot, which must be soon after the grace time, in
/// seconds, since its client left. Returns how long it took.
pub async fn gone_within(grace: f64, left: Instant, server: &Server) -> Duration {
    nothing_left(server, 1).await;
    let took = left.elapsed();
    assert!(
        took < Duration::from_secs_f64(grace + 15.0),
        "it took {took:?}, and the grace time is {grace} s"
    );
    took
}

/// The instance directories below a server's folder.
pub fn instance_folders(folder: &Path) -> Vec<PathBuf> {
    instance_folders_in(&folder.join("cache"))
}
