//! The life of a simulation in a container.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::daemon::{ask, containers, docker, of_service, server};
use crate::support::client::Client;
use crate::support::git::{Forge, arm, world};
use crate::support::{http, until};

/// How long a start may take on a busy machine.
const READY: Duration = Duration::from_secs(90);
/// All of a simulation has to be gone by then.
const GONE: Duration = Duration::from_secs(10);

/// The next simulated time that a viewer is told, in milliseconds.
async fn simulated(viewer: &mut Client) -> f64 {
    let update = viewer.until("application/json:").await;
    serde_json::from_str::<Value>(update.trim_start_matches("application/json:")).unwrap()["time"].as_f64().unwrap()
}

#[actix_rt::test]
async fn a_world_runs_in_a_container_and_nothing_is_left_when_its_client_goes() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let server = server(forge.path(), 2).start().await;
    let mut client = Client::start(&server, &arm()).await;
    let address = client.patiently("webots:", READY).await;
    let steps = ["loading: Creating network", "shutdownTimeout: 7200", "webots:ws://localhost:"];
    let order: Vec<_> = steps.iter().map(|step| client.heard.iter().position(|text| text.starts_with(step))).collect();
    assert!(order.iter().all(Option::is_some) && order.is_sorted(), "{:?}", client.heard);
    let mut viewer = Client::connect(&address.trim_start_matches("webots:").replace("localhost", "127.0.0.1")).await;
    viewer.send("x3d").await;
    viewer.until("model:").await;
    viewer.send("real-time:-1").await;
    viewer.until("application/json:").await;
    assert_eq!(http::get(&server.url("/status")).await.json()["isolation"], "container");
    assert_eq!(containers(&server).len(), 1);
    // What it takes is shown to whoever looks.
    until("the monitor shows its processor time and memory", async || {
        let page = http::get(&server.url("/monitor")).await.text();
        let value = |label: &str| {
            let (_, cell) = page.split_once(&format!("data-label=\"{label}\""))?;
            cell.split_once("data-value=\"")?.1.split_once('"')?.0.parse::<f64>().ok()
        };
        value("CPU").is_some_and(|percent| percent > 0.0) && value("Memory").is_some_and(|bytes| bytes > 1e6)
    })
    .await;
    let now = simulated(&mut viewer).await;
    // Long enough for a look at what it takes.
    while simulated(&mut viewer).await < now + 4000.0 {}
    drop(viewer);
    client.leave().await;
    let begin = Instant::now();
    until("its container is gone", async || containers(&server).is_empty()).await;
    assert!(begin.elapsed() < GONE, "{:?}", begin.elapsed());
    until("its folder is gone", async || {
        let runs = std::fs::read_dir(server.cache().join("runs")).unwrap().flatten();
        runs.flat_map(|run| std::fs::read_dir(run.path()).unwrap().flatten())
            .all(|file| !file.file_name().to_string_lossy().starts_with("instance-"))
    })
    .await;
    let read = || std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap_or_default();
    until("its end is in simulations.csv", async || read().lines().count() == 2).await;
    let table = read();
    let line: Vec<_> = table.lines().nth(1).unwrap().split(',').collect();
    let (memory, time): (u64, f64) = (line[8].parse().unwrap(), line[9].parse().unwrap());
    assert!((1 << 20..1 << 32).contains(&memory) && (0.05..100.0).contains(&time), "{table}");
    // The port is free, and the next one gets it.
    let mut next = Client::start(&server, &arm()).await;
    assert_eq!(next.patiently("webots:", READY).await, address);
}

#[actix_rt::test]
async fn who_comes_back_finds_its_container_as_it_runs() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let server = server(forge.path(), 1).start().await;
    let mut client = Client::connect(&server.websocket("/client")).await;
    client.send(&json!({"start": {"url": arm(), "resumable": true}}).to_string()).await;
    let address = client.patiently("webots:", READY).await;
    let stream = address.trim_start_matches("webots:").replace("localhost", "127.0.0.1");
    let token = client.until("resume: ").await.trim_start_matches("resume: ").to_owned();
    let mut viewer = Client::connect(&stream).await;
    viewer.send("x3d").await;
    viewer.until("scene load completed").await;
    viewer.send("real-time:-1").await;
    let left = simulated(&mut viewer).await;
    let before = of_service(&server, "webots");
    drop((client, viewer));
    let away = async || http::get(&server.url("/status")).await.json()["simulations"][0]["awayUntil"].is_u64();
    until("it is away", away).await;

    let mut client = Client::connect(&server.websocket("/client")).await;
    client.send(&json!({ "resume": token }).to_string()).await;
    assert_eq!(client.until("webots:").await, address);
    client.until("resume: ").await;
    let mut viewer = Client::connect(&stream).await;
    viewer.send("x3d;broadcast").await;
    viewer.until("real-time").await;
    let back = simulated(&mut viewer).await;
    assert!(back > left, "it began anew: {left} {back}");
    assert_eq!(of_service(&server, "webots"), before);
    drop(viewer);
    client.close_with(1000).await;
    until("its container is gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn a_container_has_no_more_than_it_needs_and_its_start_waits_for_no_heartbeat() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let server = server(forge.path(), 1)
        .set("limits", json!({ "memory": 300, "cores": 1, "processes": 77, "openFiles": 2048 }))
        .set("timing", json!({ "heartbeat": 600, "launch": 90 }))
        .start()
        .await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:", READY).await;
    let about: Value = serde_json::from_str(&ask(&["inspect", &of_service(&server, "webots")[0]])).unwrap();
    let (host, config) = (&about[0]["HostConfig"], &about[0]["Config"]);
    for (key, value) in [
        ("Privileged", json!(false)),
        ("ReadonlyRootfs", json!(true)),
        ("CapDrop", json!(["ALL"])),
        ("SecurityOpt", json!(["no-new-privileges:true"])),
        ("Memory", json!(300 << 20)),
        ("MemorySwap", json!(300 << 20)),
        ("NanoCpus", json!(1_000_000_000)),
        ("PidsLimit", json!(77)),
        ("NetworkMode", json!("webots-fleet")),
    ] {
        assert_eq!(host[key], value, "{key}");
    }
    assert_eq!(host["RestartPolicy"]["Name"], "no");
    let mounts: Vec<_> =
        about[0]["Mounts"].as_array().unwrap().iter().map(|mount| mount["Destination"].clone()).collect();
    assert_eq!(mounts, [json!("/usr/local/webots-project")]);
    assert_eq!(config["User"], format!("{}:{}", nix::unistd::getuid(), nix::unistd::getgid()));
    let environment = config["Env"].to_string();
    assert!(environment.contains("HOME=/tmp") && !environment.contains("DOCKER_HOST"), "{environment}");
}

#[actix_rt::test]
async fn an_existing_configuration_with_docker_true_runs_every_world_in_a_container() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    forge.commit("other/world", "main", &[("worlds/a.wbt", crate::support::git::WORLD)]);
    let server =
        server(forge.path(), 3).set("isolation", "auto").set("docker", true).set("shareIdleTime", 100).start().await;
    for world in [arm(), world("other/world", "main", "worlds/a.wbt")] {
        let mut client = Client::start(&server, &world).await;
        client.patiently("webots:", READY).await;
        assert_eq!(containers(&server).len(), 1, "{world}");
        client.leave().await;
        until("it is gone", async || containers(&server).is_empty()).await;
    }
}

#[actix_rt::test]
async fn worlds_of_others_run_while_the_machine_is_idle_only() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    forge.commit("other/world", "main", &[("worlds/a.wbt", crate::support::git::WORLD)]);
    let server = server(forge.path(), 2).set("shareIdleTime", 0).start().await;
    let told =
        Client::start(&server, &world("other/world", "main", "worlds/a.wbt")).await.until("loading: Error:").await;
    assert!(told.contains("not configured to share idle time"), "{told}");
}

#[actix_rt::test]
async fn more_simulations_run_than_docker_has_networks() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let count = super::daemon::NETWORKS + 2;
    let server = server(forge.path(), count).set("maxPlacesPerAddress", count).start().await;
    let mut clients = Vec::new();
    for _ in 0..count {
        clients.push(Client::start(&server, &arm()).await);
    }
    for client in &mut clients {
        client.patiently("webots:", READY).await;
    }
    assert_eq!(containers(&server).len(), usize::from(count));
}
