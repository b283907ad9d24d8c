//! The life of a simulation, from the first message to the last trace.

use crate::support::client::Client;
use crate::support::git::{Forge, world};
use crate::support::program::simulation_server;
use crate::support::until;
use crate::support::webots::{Webots, instances_below};

#[actix_rt::test]
async fn a_simulation_runs_from_the_first_message_to_the_last_trace() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 2).start().await;
    let mut client = Client::start(&server, &world("lab/arm", "main", "worlds/a.wbt")).await;
    assert_eq!(client.until("shutdownTimeout").await, "shutdownTimeout: 7200");
    let url = client.until("webots:").await;
    assert_eq!(url, format!("webots:ws://localhost:{}", server.port + 1));
    let mut viewer = Client::connect(&format!("ws://127.0.0.1:{}/", server.port + 1)).await;
    viewer.send("x3d").await;
    viewer.until("scene load completed").await;
    assert!(instances_below(&server.folder).len() >= 3, "guardian, launcher and simulator");
    client.leave().await;
    until("nothing of the simulation is left", async || {
        let runs = std::fs::read_dir(server.folder.join("cache/runs")).unwrap();
        let folders = runs.flat_map(|run| std::fs::read_dir(run.unwrap().path()).unwrap()).count();
        instances_below(&server.folder).is_empty() && folders == 2
    })
    .await;
}
