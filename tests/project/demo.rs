//! The demo, with the README's steps for a newcomer.

use std::process::Stdio;

use futures_util::SinkExt;
use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::Pid;
use tokio::io::AsyncBufReadExt;
use tokio::net::TcpListener;
use tokio_tungstenite::accept_async;
use tokio_tungstenite::tungstenite::Message;

use super::copy::{Project, nothing_is_left, processes_in, root};
use crate::support::client::Client;
use crate::support::webots::instance_folders_in;
use crate::support::{SOON, http, until};

const WORLD: &str = "https://github.com/webots-fleet/demo/blob/main/worlds/playground.wbt";

/// A client whose simulation of the demo's world is ready, and the URL of its stream.
async fn simulate(project: &Project) -> (Client, String) {
    let mut client = Client::connect(&format!("ws://localhost:{}/client", project.simulation)).await;
    client
        .send(&serde_json::json!({"start": {"url": WORLD}}).to_string())
        .await;
    let url = client.until("webots:").await.trim_start_matches("webots:").to_owned();
    (client, url)
}

/// The lines that the README's client prints, up to one that begins with `last`.
async fn talk(project: &Project, url: &str, message: &str, last: &str) -> Vec<String> {
    // A shell can't reset an ignored SIGINT, which it inherits from `nohup tests/run.sh &`.
    let mut child = tokio::process::Command::new("env")
        .arg("--default-signal=INT")
        .arg(project.path("tests/websocket.sh"))
        .args([url, message])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .process_group(0)
        .spawn()
        .unwrap();
    let group = Pid::from_raw(child.id().unwrap().try_into().unwrap());
    let mut reader = tokio::io::BufReader::new(child.stdout.take().unwrap()).lines();
    let mut heard: Vec<String> = Vec::new();
    while !heard.last().is_some_and(|line| line.starts_with(last)) {
        let line = actix_rt::time::timeout(SOON, reader.next_line()).await;
        let Ok(Ok(Some(line))) = line else {
            panic!("only {heard:?} came")
        };
        heard.push(line);
    }
    // As Ctrl-C does.
    killpg(group, Signal::SIGINT).unwrap();
    actix_rt::time::timeout(SOON, child.wait()).await.unwrap().unwrap();
    heard
}

/// The header of a frame tells a length in three ways.
#[actix_rt::test]
async fn the_client_of_the_documentation_prints_texts_of_any_length() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("ws://{}/", listener.local_addr().unwrap());
    let texts = [1, 125, 126, 127, 128, 65_535, 65_536].map(|length| "x".repeat(length));
    let sent = texts.clone();
    actix_rt::spawn(async move {
        let (socket, _) = listener.accept().await.unwrap();
        let mut socket = accept_async(socket).await.unwrap();
        for text in sent {
            socket.send(Message::text(text)).await.unwrap();
        }
        socket.close(None).await.unwrap();
    });
    let client = tokio::process::Command::new(root().join("tests/websocket.sh"))
        .arg(url)
        .stdin(Stdio::null())
        .kill_on_drop(true)
        .output();
    let output = actix_rt::time::timeout(SOON, client).await.unwrap().unwrap();
    let told = String::from_utf8_lossy(&output.stdout);
    assert!(
        told.lines().eq(&texts),
        "{:?}",
        told.lines().map(str::len).collect::<Vec<_>>()
    );
}

#[actix_rt::test]
async fn the_demo_runs_from_its_start_to_its_stop() {
    needs!("bwrap");
    let project = Project::copy();
    let told = project.done(&["start", "demo"]).await;
    let session = project.session;
    let simulation = project.simulation;
    for part in [
        format!("http://localhost:{session}/monitor"),
        format!("ws://localhost:{session}/session"),
        format!("http://localhost:{simulation}/monitor"),
        format!("ws://localhost:{simulation}/client"),
    ] {
        assert!(told.contains(&part), "{part} is missing: {told}");
    }

    until("a client can be placed", async || {
        http::get(&project.session_url("/request")).await.text() == "1"
    })
    .await;
    let answer = talk(&project, &format!("ws://localhost:{session}/session"), WORLD, "ws:").await;
    assert_eq!(answer, ["1".to_owned(), format!("ws://localhost:{simulation}")]);
    for path in ["/monitor", "/status", "/load", "/metrics", "/health", "/request"] {
        assert_eq!(http::get(&project.session_url(path)).await.status, 200, "{path}");
    }
    let start = serde_json::json!({"start": {"url": WORLD}}).to_string();
    let answer = talk(
        &project,
        &format!("ws://localhost:{simulation}/client"),
        &start,
        "webots:",
    )
    .await;
    let stream = format!("webots:ws://localhost:{simulation}/stream/");
    assert!(answer.last().unwrap().starts_with(&stream), "{answer:?}");
    until("neither a process nor a folder of the simulation is left", async || {
        instance_folders_in(&project.path("cache")).is_empty() && processes_in(&project.path("cache")).is_empty()
    })
    .await;
    assert!(
        project
            .done(&["status"])
            .await
            .contains("demo: the session server runs")
    );
    let before = ["session", "simulation"].map(|kind| project.pid(kind, "demo"));
    let (mut client, url) = simulate(&project).await;
    let mut viewer = Client::connect(&url).await.with_running_scene().await;
    let told = project.done(&["restart"]).await;
    let after = ["session", "simulation"].map(|kind| project.pid(kind, "demo"));
    assert!(before[0] != after[0] && before[1] != after[1], "{before:?} {after:?}");
    let words = format!(
        "process {} serves its 1 simulations until their clients leave",
        before[1]
    );
    assert!(told.contains(&words), "{told}");
    // The simulation goes on, and is stopped with the server.
    let time = viewer.time().await;
    while viewer.time().await <= time {}
    project.configure("simulation/demo", |config| config["port"] = 1.into());
    let refused = project.server_sh(&["restart", "demo"]).await;
    assert_eq!(refused.code, Some(1), "{refused:#?}");
    assert!(refused.errors.contains("needs a stop and a start"), "{refused:#?}");
    assert_eq!(after, ["session", "simulation"].map(|kind| project.pid(kind, "demo")));
    project.configure("simulation/demo", |config| config["port"] = simulation.into());
    let stopped = project.done(&["stop"]).await;
    assert!(stopped.contains("stopped the session server") && stopped.contains("stopped the simulation server"));
    assert_eq!(client.closed().await, Some(1001));
    nothing_is_left(&project).await;
    assert_eq!(project.server_sh(&["status"]).await.code, Some(3));
    assert_eq!(project.server_sh(&["status", "demo"]).await.code, Some(3));
    assert_eq!(project.done(&["stop", "demo"]).await, "nothing of demo runs\n");
}

#[actix_rt::test]
async fn a_server_that_does_not_end_is_killed_with_what_it_started() {
    needs!("bwrap");
    let project = Project::copy();
    project.configure("simulation/demo", |config| {
        config["timing"] = serde_json::json!({"stop": 1})
    });
    project.done(&["start", "demo"]).await;
    let (_client, _) = simulate(&project).await;
    kill(Pid::from_raw(project.pid("simulation", "demo")), Signal::SIGSTOP).unwrap();
    let stopped = project.done(&["stop"]).await;
    assert!(stopped.contains("killed the simulation server of demo"), "{stopped}");
    // The killed server could not remove the folder of its run; the next start does.
    until("no process is left", async || {
        processes_in(&project.folder()).is_empty()
    })
    .await;
    project.done(&["start", "demo"]).await;
    project.done(&["stop"]).await;
    nothing_is_left(&project).await;
}

#[actix_rt::test]
async fn without_webots_a_client_is_told_what_to_do() {
    let project = Project::copy();
    let home = project.path("no webots here");
    project.configure("simulation/local", |config| {
        config["webotsHome"] = home.to_str().unwrap().into()
    });
    // Without a name, `server.sh` takes the configuration `local`.
    let started = project.server_sh(&["start"]).await;
    assert_eq!(started.code, Some(0), "{started:#?}");
    assert!(
        started
            .errors
            .contains("warning: webots: This simulation server has no Webots"),
        "{started:#?}"
    );
    let mut client = Client::connect(&format!("ws://localhost:{}/client", project.simulation)).await;
    let world = "https://github.com/cyberbotics/webots/blob/released/projects/languages/python/worlds/example.wbt";
    client
        .send(&serde_json::json!({"start": {"url": world}}).to_string())
        .await;
    client.closed().await;
    assert_eq!(client.reason()["code"], "not-ready");
    let [_, told] = client.heard.as_slice() else {
        panic!("{:?}", client.heard)
    };
    assert!(told.starts_with("loading: Error: "), "{told}");
    assert!(
        told.contains("has no Webots that it can run at \"webots\"") && told.contains("webotsHome"),
        "{told}"
    );
    project.done(&["stop"]).await;
    nothing_is_left(&project).await;
}
