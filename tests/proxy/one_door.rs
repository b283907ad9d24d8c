//! A fleet of several machines behind one nginx (`deploy/nginx-door.conf`, `publicUrl`). The machines are 127.0.0.2 and 127.0.0.3,
//! whose servers have the same port. `tests/swarm.sh` tests the door of `deploy/swarm`, whose rules `deploy/kubernetes` shares.

use super::exposure::private_service;
use super::fleet::{Fleet, PLACES, arm};
use super::rules::Rules;
use super::whole_way::the_whole_way;
use crate::support::until;

#[actix_rt::test]
async fn the_door_leads_to_the_whole_fleet_and_nowhere_else() {
    leads_nowhere_else(&the_whole_way(Rules::Door).await).await;
}

#[actix_rt::test]
async fn who_is_lost_comes_back_through_the_door() {
    let fleet = Fleet::start(Rules::Door).await;
    let mut tokens = Vec::new();
    for server in [&fleet.here, &fleet.there] {
        let mut lost = fleet.browser.open(&format!("{}/client", fleet.wss(server))).await;
        lost.send(&serde_json::json!({"start": {"url": arm(), "resumable": true}}).to_string())
            .await;
        let stream = lost.until("webots:").await["webots:".len()..].to_owned();
        tokens.push((lost.token().await, stream));
        drop(lost);
    }
    // Each simulation is resumed at its own machine only, from another address.
    let browser = fleet.browser.at("127.0.0.9");
    for (number, server) in [&fleet.here, &fleet.there].into_iter().enumerate() {
        let client = format!("{}/client", fleet.wss(server));
        let mut stranger = browser.open(&client).await.resume(&tokens[1 - number].0).await;
        assert_eq!(stranger.until("").await, "loading: Error: this simulation has ended");
        assert_eq!(stranger.closed().await, Some(1000));
        let (token, stream) = &tokens[number];
        let mut back = browser.open(&client).await.resume(token).await;
        assert_eq!(back.until("webots:").await, format!("webots:{stream}"));
        let mut viewer = browser.open(&format!("{stream}/")).await;
        viewer.send("w3d;broadcast").await;
        viewer.until("scene load completed").await;
        // It counts once, at its own server and at the session server.
        until("both servers say so", async || {
            let own = browser
                .get(&format!("{}/status", fleet.path(server, server.port)))
                .await
                .json();
            let known = browser.get("/status").await.json()["servers"][number]["instances"].clone();
            own["instances"]["arrivals"] == 1 && own["simulations"].as_array().unwrap().len() == 1 && known["idle"] == 1
        })
        .await;
        back.close_with(1000).await;
        viewer.closed().await;
    }
}

async fn leads_nowhere_else(fleet: &Fleet) {
    let private = private_service();
    let port = fleet.here.port;
    for path in [
        // Another host: this machine, one of its names, one on the internet.
        format!("/127.0.0.1/{private}/"),
        format!("/localhost/{port}/"),
        format!("/127.0.0.2.example.org/{port}/"),
        format!("/127.0.0.22/{port}/"),
        format!("/example.org/{port}/"),
        // Another port of a machine of the fleet.
        "/127.0.0.2/22/".to_owned(),
        format!("/127.0.0.2/{private}/"),
        format!("/127.0.0.2/{port}0/"),
        format!("/127.0.0.2/0{port}/"),
        format!("/127.0.0.2/{}/", port + PLACES + 1),
        format!("/127.0.0.2/{port}/../../127.0.0.1/{private}/"),
        format!("/127.0.0.2/{port}/%2e%2e/%2e%2e/127.0.0.1/{private}/"),
        format!("/127.0.0.2:{private}/{port}/"),
        format!("/127.0.0.2/{port}@127.0.0.1:{private}/"),
        format!("/127.0.0.2%40127.0.0.1/{port}/"),
        format!("/127.0.0.1%23127.0.0.2/{port}/"),
        format!("/%0a127.0.0.2/{port}/"),
        // The session server has no such path, and its port is not one of a simulation server.
        format!("/127.0.0.1/{}/status", fleet.session.port),
        format!("/{port}/"),
        // For administrators only.
        format!("/127.0.0.2/{port}/drain"),
        format!("/127.0.0.2/{port}/%64rain"),
    ] {
        fleet.browser.finds_nothing(&path).await;
    }
}
