//! What remains after the server or the daemon is killed.

use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

use super::daemon::{self, alone, ask, check, containers, docker, refused, running, server, server_running};
use crate::support::{Client, Server, arm, until};

/// Longest time until nothing of a simulation remains.
const GONE: Duration = Duration::from_secs(10);

/// Whether a server reports that it can start simulations. Not by its load, which also depends on the machine.
async fn takes_clients(server: &Server) -> bool {
    server.status().await["problem"].is_null()
}

#[actix_rt::test]
async fn everything_is_gone_soon_after_the_server_was_killed() {
    let Some(_docker) = docker().await else { return };
    for (signal, words, code) in [
        (Signal::SIGKILL, "webots:", None),
        (Signal::SIGTERM, "loading: Creating network", Some(0)),
    ] {
        let (mut server, _client) = running(server(2)).await;
        let mut other = Client::start(&server, &arm()).await;
        other.patiently(words).await;
        server.signal(signal);
        assert_eq!(server.ended().await, code);
        let begin = Instant::now();
        until("the containers are gone", async || containers(&server).is_empty()).await;
        assert!(begin.elapsed() < GONE, "{:?}", begin.elapsed());
    }
}

#[actix_rt::test]
async fn only_leftovers_of_this_server_are_removed() {
    let Some(_docker) = docker().await else { return };
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("cache")).unwrap();
    let owner = webots_fleet::simulation::container::ResourceOwner::of(&folder.path().join("cache"));
    let make = |name: &str, project: &str| {
        let label = format!("com.docker.compose.project={project}");
        ask(&[
            "create",
            "--name",
            name,
            "--label",
            &label,
            "--network",
            "none",
            super::image::NAME,
            "sleep",
            "1000",
        ])
    };
    let mine = owner.project(2001);
    let other = "webots-fleet-000000000000-2001-0".to_owned();
    // An image's label may have any text, and its containers inherit it.
    let containers = [
        (format!("{mine}-webots"), &mine),
        (format!("{other}-webots"), &other),
        ("forged".to_owned(), &mine),
    ]
    .map(|(name, project)| make(&name, project));
    let _server = server(1).folder(folder.path()).start().await;
    let is_there = |container: &str| {
        !ask(&[
            "ps",
            "--all",
            "--quiet",
            "--no-trunc",
            "--filter",
            &format!("id={container}"),
        ])
        .is_empty()
    };
    until("what it left is gone", async || !is_there(&containers[0])).await;
    assert!(is_there(&containers[1]) && is_there(&containers[2]));
    ask(&["rm", &containers[1], &containers[2]]);
}

#[actix_rt::test]
async fn a_server_that_is_started_again_at_once_keeps_what_it_starts() {
    let Some(_docker) = docker().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let (mut first, _client) = running(server(1).folder(folder.path())).await;
    first.signal(Signal::SIGKILL);
    first.ended().await;
    // The guardian of the first server may still be removing its containers.
    let (second, mut client) = running(server(1).folder(folder.path())).await;
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(8) {
        client.patiently(".").await;
    }
    assert_eq!(containers(&second).len(), 1);
}

#[actix_rt::test]
async fn a_stopped_docker_is_reported_until_it_is_back() {
    let Some(_docker) = alone().await else { return };
    let (server, mut client) = running(server(2)).await;
    daemon::kill();
    let lost = client.patiently("loading: Error:").await;
    assert!(lost.contains("Docker has stopped on this simulation server"), "{lost}");
    // Another server may take the client.
    assert_eq!(client.closed().await, Some(1013));
    // The server has not checked Docker yet when the first client comes.
    for _ in 0..2 {
        let (told, code) = refused(&server, &arm()).await;
        assert!(
            told.contains("Docker does not answer on this simulation server"),
            "{told}"
        );
        assert_eq!(code, Some(1013));
    }
    until("it says so", async || !takes_clients(&server).await).await;
    let checked = check(&server);
    assert!(checked.contains("warning: docker: Docker does not answer"), "{checked}");
    until("it has tried to remove what the first has left", async || {
        server.log().contains("Docker can't remove the containers of ")
    })
    .await;
    daemon::start_again();
    let kept = containers(&server);
    assert_eq!(kept.len(), 1, "{kept:?}");
    until("it takes clients again", async || takes_clients(&server).await).await;
    until("what the daemon has kept is gone", async || {
        containers(&server).is_empty()
    })
    .await;
    until("the log says so", async || {
        server.log().contains("Docker answers again: the containers of ")
    })
    .await;
    Client::start(&server, &arm()).await.patiently("webots:").await;
}

#[actix_rt::test]
async fn an_end_that_looks_like_a_stopped_docker_is_the_worlds() {
    let Some(_docker) = docker().await else { return };
    for (line, words) in [("exit 143", "exit code 143"), ("kill -KILL $$", "exit code 137")] {
        let server = server_running(line).start().await;
        let (told, code) = refused(&server, &arm()).await;
        assert!(told.contains(words) && !told.contains("Docker"), "{told}");
        assert_eq!(code, Some(1000));
        assert_eq!(server.status().await["failedStarts"], 0);
    }
}

#[actix_rt::test]
async fn a_start_that_docker_refuses_is_the_servers_fault() {
    let Some(_docker) = docker().await else { return };
    let server = server(1).set("container", serde_json::json!({ "mounts": ["/nowhere/x:relative"] }));
    let server = server.start().await;
    let (told, code) = refused(&server, &arm()).await;
    assert!(
        told.contains("Docker can't start the containers of this simulation"),
        "{told}"
    );
    assert_eq!((code, &server.status().await["failedStarts"]), (Some(1013), &1.into()));
}
