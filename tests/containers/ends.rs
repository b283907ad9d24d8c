//! What is left when things end that should not: the server, the daemon.

use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

use super::daemon::{alone, ask, check, containers, containers_of, docker, prefix, server};
use crate::support::client::Client;
use crate::support::git::{Forge, arm};
use crate::support::program::Server;
use crate::support::{http, until};

/// All of a simulation has to be gone by then.
const GONE: Duration = Duration::from_secs(10);

/// Whether a server says that it can start simulations; its load tells of a busy machine too.
async fn takes_clients(server: &Server) -> bool {
    http::get(&server.url("/status")).await.json()["problem"].is_null()
}

#[actix_rt::test]
async fn everything_is_gone_soon_after_the_server_was_killed() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let mut server = server(forge.path(), 2).start().await;
    let mut clients = vec![Client::start(&server, &arm()).await, Client::start(&server, &arm()).await];
    for client in &mut clients {
        client.patiently("webots:", Duration::from_secs(60)).await;
    }
    let prefix = prefix(&server);
    server.signal(Signal::SIGKILL);
    server.ended().await;
    let begin = Instant::now();
    until("the containers are gone", async || containers_of(&prefix).is_empty()).await;
    assert!(begin.elapsed() < GONE, "{:?}", begin.elapsed());
}

#[actix_rt::test]
async fn a_server_that_stops_leaves_nothing() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let mut server = server(forge.path(), 2).start().await;
    let mut running = Client::start(&server, &arm()).await;
    running.patiently("webots:", Duration::from_secs(60)).await;
    let mut starting = Client::start(&server, &arm()).await;
    starting.patiently("loading: Creating network", Duration::from_secs(60)).await;
    let prefix = prefix(&server);
    server.signal(Signal::SIGTERM);
    assert_eq!(server.ended().await, Some(0));
    until("the containers are gone", async || containers_of(&prefix).is_empty()).await;
}

#[actix_rt::test]
async fn what_an_earlier_run_has_left_is_removed_and_nothing_of_others() {
    let Some(_docker) = docker().await else { return };
    let (forge, folder) = (Forge::with_arm(), tempfile::tempdir().unwrap());
    std::fs::create_dir(folder.path().join("cache")).unwrap();
    let owner = webots_fleet::simulation::container::ResourceOwner::of(&folder.path().join("cache"));
    let make = |name: &str, project: &str| {
        let label = format!("com.docker.compose.project={project}");
        ask(&["create", "--name", name, "--label", &label, "--network", "none", super::image::NAME, "sleep", "1000"])
    };
    let (mine, other) = (owner.project(2001), "webots-fleet-000000000000-2001-0".to_owned());
    // The label of an image may have any text, and its containers inherit it.
    let containers =
        [(format!("{mine}-webots"), &mine), (format!("{other}-webots"), &other), ("forged".to_owned(), &mine)]
            .map(|(name, project)| make(&name, project));
    let _server = server(forge.path(), 1).folder(folder.path()).start().await;
    let is_there = |container: &str| {
        !ask(&["ps", "--all", "--quiet", "--no-trunc", "--filter", &format!("id={container}")]).is_empty()
    };
    until("what it left is gone", async || !is_there(&containers[0])).await;
    assert!(is_there(&containers[1]) && is_there(&containers[2]));
    ask(&["rm", &containers[1], &containers[2]]);
}

#[actix_rt::test]
async fn a_server_that_is_started_again_at_once_keeps_what_it_starts() {
    let Some(_docker) = docker().await else { return };
    let (forge, folder) = (Forge::with_arm(), tempfile::tempdir().unwrap());
    let mut first = server(forge.path(), 1).folder(folder.path()).start().await;
    Client::start(&first, &arm()).await.patiently("webots:", Duration::from_secs(60)).await;
    first.signal(Signal::SIGKILL);
    first.ended().await;
    // The guardian of the first may still be removing what that has left.
    let second = server(forge.path(), 1).folder(folder.path()).start().await;
    let mut client = Client::start(&second, &arm()).await;
    client.patiently("webots:", Duration::from_secs(60)).await;
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(8) {
        client.patiently(".", Duration::from_secs(20)).await;
    }
    assert_eq!(containers(&second).len(), 1);
}

#[actix_rt::test]
async fn a_docker_that_is_stopped_or_has_no_init_process_is_told_and_all_goes_on_when_it_is_back() {
    let Some(docker) = alone().await else { return };
    let forge = Forge::with_arm();
    let server = server(forge.path(), 2).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:", Duration::from_secs(60)).await;
    docker.kill();
    let lost = client.patiently("loading: Error:", Duration::from_secs(60)).await;
    assert!(lost.contains("Docker has stopped on this simulation server"), "{lost}");
    // Another server may take it.
    assert_eq!(client.closed().await, Some(1013));
    // The first after that comes before the server has looked.
    let mut next = Client::start(&server, &arm()).await;
    let told = next.patiently("loading: Error:", Duration::from_secs(60)).await;
    assert!(told.contains("Docker does not answer on this simulation server"), "{told}");
    assert_eq!(next.closed().await, Some(1013));
    let told = Client::start(&server, &arm()).await.patiently("loading: Error:", Duration::from_secs(60)).await;
    assert!(told.contains("Docker does not answer on this simulation server"), "{told}");
    until("it says so", async || !takes_clients(&server).await).await;
    docker.start(&["--init-path", "/nowhere/docker-init"]);
    let second = super::daemon::server(forge.path(), 1).start().await;
    until("it takes no client", async || !takes_clients(&second).await).await;
    let told = Client::start(&second, &arm()).await.patiently("loading: Error:", Duration::from_secs(60)).await;
    assert!(told.contains("docker-init: on Debian and Ubuntu the packages docker.io and tini"), "{told}");
    let checked = check(&second);
    assert!(checked.contains("can't give containers an init process"), "{checked}");
    docker.kill();
    docker.start(&[]);
    for server in [&server, &second] {
        until("it takes clients again", async || takes_clients(server).await).await;
        Client::start(server, &arm()).await.patiently("webots:", Duration::from_secs(60)).await;
    }
    until("what the daemon has kept is gone", async || containers(&server).len() <= 1).await;
}

#[actix_rt::test]
async fn a_world_that_ends_like_one_of_a_stopped_docker_is_not_taken_for_that() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let server = server(forge.path(), 1).start().await;
    let dockerfile = format!(
        "FROM {}\nCOPY . /usr/local/webots-project\nRUN cp /usr/local/webots-project/fake /usr/local/webots/webots && chmod \
         755 /usr/local/webots/webots\n",
        super::image::NAME
    );
    for (line, words) in [("exit 143", "exit code 143"), ("kill -KILL $$", "exit code 137")] {
        forge.commit("lab/arm", "main", &[("Dockerfile", &dockerfile), ("fake", &format!("#!/bin/sh\n{line}\n"))]);
        let mut client = Client::start(&server, &arm()).await;
        let told = client.patiently("loading: Error:", Duration::from_secs(90)).await;
        assert!(told.contains(words) && !told.contains("Docker"), "{told}");
        assert_eq!(client.closed().await, Some(1000));
        assert_eq!(http::get(&server.url("/status")).await.json()["failedStarts"], 0);
    }
}

#[actix_rt::test]
async fn a_container_that_docker_is_told_to_stop_is_not_the_worlds_fault() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let server = server(forge.path(), 1).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:", Duration::from_secs(60)).await;
    ask(&["stop", &super::daemon::of_service(&server, "webots")[0]]);
    let told = client.patiently("loading: Error:", Duration::from_secs(60)).await;
    assert!(told.contains("Docker has stopped"), "{told}");
    assert_eq!(client.closed().await, Some(1013));
}

#[actix_rt::test]
async fn a_start_that_docker_refuses_counts_against_the_server_and_not_the_world() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let server = server(forge.path(), 1).set("container", serde_json::json!({ "mounts": ["/nowhere/x:relative"] }));
    let server = server.start().await;
    let mut client = Client::start(&server, &arm()).await;
    let told = client.patiently("loading: Error:", Duration::from_secs(60)).await;
    assert!(told.contains("failed:"), "{told}");
    assert_eq!(client.closed().await, Some(1013));
    assert_eq!(http::get(&server.url("/status")).await.json()["failedStarts"], 1);
}
