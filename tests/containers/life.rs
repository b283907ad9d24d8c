//! The life of a simulation in a container.

use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use webots_fleet::simulation::container::ResourceOwner;

use super::builds::{is_there, load};
use super::daemon::{self, ask, containers, docker, of_service, running, server};
use super::image::NAME;
use crate::support::{Client, SOON, WORLD, arm, instance_folders_in, is_told, until, world};

/// Longest time until nothing of a simulation remains.
const GONE: Duration = Duration::from_secs(10);

#[actix_rt::test]
async fn a_world_runs_in_a_container_and_leaves_nothing() {
    let Some(_docker) = docker().await else { return };
    let (server, client) = running(server(2)).await;
    let steps = [
        "loading: Creating network",
        "shutdownTimeout: 7200",
        "webots:ws://localhost:",
    ];
    let order: Vec<_> = steps
        .iter()
        .map(|step| client.heard.iter().position(|text| text.starts_with(step)))
        .collect();
    assert!(
        order.iter().all(Option::is_some) && order.is_sorted(),
        "{:?}",
        client.heard
    );
    let mut viewer = Client::connect(&format!("ws://127.0.0.1:{}/", server.port + 1))
        .await
        .with_running_scene()
        .await;
    assert_eq!(server.status().await["isolation"], "container");
    assert_eq!(containers(&server).len(), 1);
    until("the monitor shows its processor time and memory", async || {
        let page = server.monitor().await;
        let value = |label: &str| {
            let (_, cell) = page.split_once(&format!("data-label=\"{label}\""))?;
            cell.split_once("data-value=\"")?
                .1
                .split_once('"')?
                .0
                .parse::<f64>()
                .ok()
        };
        value("CPU").is_some_and(|percent| percent > 0.0) && value("Memory").is_some_and(|bytes| bytes > 1e6)
    })
    .await;
    let now = viewer.time().await;
    // Long enough for a measurement of its usage.
    while viewer.time().await < now + 4000.0 {}
    drop(viewer);
    client.leave().await;
    let begin = Instant::now();
    until("its container is gone", async || containers(&server).is_empty()).await;
    assert!(begin.elapsed() < GONE, "{:?}", begin.elapsed());
    until("its folder is gone", async || {
        instance_folders_in(&server.cache()).is_empty()
    })
    .await;
    let read = || std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap_or_default();
    until("its end is in simulations.csv", async || read().lines().count() == 2).await;
    // The port is free again, and the next simulation gets it.
    let mut next = Client::start(&server, &arm()).await;
    assert_eq!(
        next.patiently("webots:").await,
        format!("webots:ws://localhost:{}", server.port + 1)
    );
}

#[actix_rt::test]
async fn a_container_is_ready_when_its_world_is() {
    let Some(_docker) = docker().await else { return };
    let options = "\n#demo-simulator: download=2 load=2\n";
    let server = daemon::server_with(&[("worlds/a.wbt", &WORLD.replacen('\n', options, 1))]);
    let server = server.start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("loading: Webots: Downloading assets: ").await;
    let begin = Instant::now();
    let told = client.patiently("webots:").await;
    let url = told.strip_prefix("webots:").unwrap();
    // The download's first texts come at its beginning.
    assert!(begin.elapsed() > Duration::from_secs(2), "{:?}", begin.elapsed());
    // A viewer crashes a Webots without a world.
    let viewer = Client::connect(&format!("{url}/")).await.with_running_scene().await;
    drop(viewer);
    client.patiently(".").await;
}

#[actix_rt::test]
async fn who_comes_back_finds_its_container_as_it_runs() {
    let Some(_docker) = docker().await else { return };
    let server = server(1).start().await;
    let (client, token) = Client::resumable(&server).await;
    let stream = format!("ws://127.0.0.1:{}/", server.port + 1);
    let mut viewer = Client::connect(&stream).await.with_running_scene().await;
    let left = viewer.time().await;
    let before = of_service(&server, "webots");
    drop((client, viewer));
    server.until_away(1).await;

    let mut client = Client::resuming(&server, &token).await;
    client.token().await;
    let mut viewer = Client::connect(&stream).await;
    viewer.send("w3d;broadcast").await;
    viewer.until("real-time").await;
    let back = viewer.time().await;
    assert!(back > left, "it began anew: {left} {back}");
    assert_eq!(of_service(&server, "webots"), before);
    drop(viewer);
    client.close_with(1000).await;
    until("its container is gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn a_container_has_no_more_than_it_needs() {
    let Some(_docker) = docker().await else { return };
    let limits = json!({ "memory": 300, "cores": 1, "processes": 77, "openFiles": 2048 });
    let server = server(1)
        .set("limits", limits)
        .set("timing", json!({ "heartbeat": 600, "launch": 90, "arrival": 0 }));
    let (server, _client) = running(server).await;
    let about: Value = serde_json::from_str(&ask(&["inspect", &of_service(&server, "webots")[0]])).unwrap();
    let host = &about[0]["HostConfig"];
    let config = &about[0]["Config"];
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
    assert_eq!(about[0]["Mounts"].as_array().unwrap().len(), 1);
    assert_eq!(about[0]["Mounts"][0]["Destination"], "/usr/local/webots-project");
    assert_eq!(
        config["User"],
        format!("{}:{}", nix::unistd::getuid(), nix::unistd::getgid())
    );
    let environment = config["Env"].to_string();
    assert!(
        environment.contains("HOME=/tmp") && !environment.contains("DOCKER_HOST"),
        "{environment}"
    );
}

#[actix_rt::test]
async fn docker_true_runs_every_world_in_a_container() {
    let Some(_docker) = docker().await else { return };
    let server = server(3)
        .set("isolation", "auto")
        .set("docker", true)
        .set("shareIdleTime", 100)
        .start()
        .await;
    server.forge().commit("other/world", "main", &[("worlds/a.wbt", WORLD)]);
    for world in [arm(), world("other/world", "main", "worlds/a.wbt")] {
        let mut client = Client::start(&server, &world).await;
        client.patiently("webots:").await;
        assert_eq!(containers(&server).len(), 1, "{world}");
        client.leave().await;
        until("it is gone", async || containers(&server).is_empty()).await;
    }
    let server = daemon::server(2).set("shareIdleTime", 0).start().await;
    is_told(
        &server,
        &world("other/world", "main", "worlds/a.wbt"),
        "not configured to share idle time",
    )
    .await;
}

#[actix_rt::test]
async fn more_simulations_run_than_docker_has_networks() {
    let Some(_docker) = docker().await else { return };
    let count = daemon::NETWORKS + 2;
    let server = server(count).set("maxPlacesPerAddress", count).start().await;
    let mut clients = Vec::new();
    for _ in 0..count {
        clients.push(Client::start(&server, &arm()).await);
    }
    for client in &mut clients {
        client.patiently("webots:").await;
    }
    assert_eq!(containers(&server).len(), usize::from(count));
}

#[actix_rt::test]
async fn a_container_that_nobody_views_ends() {
    let Some(_docker) = docker().await else { return };
    let server = server(2).set("timing.arrival", 10).start().await;
    let mut watched = Client::start(&server, &arm()).await;
    let told = watched.patiently("webots:").await;
    let url = told.trim_start_matches("webots:").replace("localhost", "127.0.0.1");
    let _viewer = Client::connect(&format!("{url}/")).await;
    let mut unseen = Client::start(&server, &arm()).await;
    unseen.patiently("webots:").await;
    unseen.within("loading: Error:", 2 * SOON).await;
    assert_eq!(unseen.reason()["code"], "no-viewer");
    // The other's time was over before.
    until("one is left", async || server.simulations().await.len() == 1).await;
    assert_eq!(server.simulations().await[0]["id"], watched.id());
}

#[actix_rt::test]
async fn an_upgrade_ends_no_container() {
    let Some(_docker) = docker().await else { return };
    let server = server(3).start().await;
    let mut first = Client::start(&server, &arm()).await;
    first.patiently("webots:").await;
    let mut viewer = Client::connect(&format!("ws://127.0.0.1:{}/", server.port + 1))
        .await
        .with_running_scene()
        .await;
    let now = viewer.time().await;
    let before = containers(&server);
    // An image that is old enough to be removed, if the older process did not need it.
    let owner = ResourceOwner::of(&server.cache()).0;
    load(&server.folder, "of-both", &owner, "-6 years");
    let (succeeds, told) = server.upgrade().await;
    assert!(succeeds, "{told}");
    assert!(viewer.time().await >= now, "it began anew");
    let mut second = Client::start(&server, &arm()).await;
    second.patiently("webots:").await;
    assert_eq!(containers(&server).len(), 2);
    assert!(is_there("of-both"));
    drop(viewer);
    first.leave().await;
    until("the older process has ended", async || server.processes().len() == 1).await;
    until("its container is gone", async || containers(&server).len() == 1).await;
    assert!(!before.contains(&containers(&server)[0]));
    second.leave().await;
    until("all containers are gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn the_script_for_a_real_webots_runs_worlds_in_containers() {
    let Some(_docker) = docker().await else { return };
    let root = env!("CARGO_MANIFEST_DIR");
    let simulator = env!("CARGO_BIN_EXE_demo-simulator");
    let mut script = Command::new(format!("{root}/tests/real-webots.sh"));
    script.args(["--program", simulator, "--isolation", "container", "--image", NAME]);
    script
        .arg(format!("{root}/tests/real_webots/project/worlds/window.wbt"))
        .env("FLEET_BIN", std::path::Path::new(simulator).parent().unwrap())
        .env("DOCKER_HOST", daemon::host())
        .env("DOCKER_CONFIG", daemon::folder());
    let output = actix_rt::task::spawn_blocking(move || script.output().unwrap())
        .await
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    let rows: Vec<Vec<_>> = text.lines().map(|line| line.split(" | ").collect()).collect();
    for stream in ["direct", "relay"] {
        let is_row = |row: &&Vec<_>| row.starts_with(&["| container", stream, "window"]);
        let row = rows.iter().find(is_row).unwrap_or_else(|| panic!("{output:?}"));
        assert_eq!(row.last(), Some(&"ok |"), "{text}");
    }
    assert!(output.status.success(), "{output:?}");
}
