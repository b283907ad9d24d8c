//! A fleet of several machines behind one nginx (`deploy/nginx-door.conf`, that of `deploy/kubernetes`, `publicUrl`). The
//! machines are 127.0.0.2 and 127.0.0.3, whose servers have the same port.

use tokio::net::TcpStream;

use super::exposure::private_service;
use super::fleet::{Fleet, PLACES, arm};
use super::rules::Rules;
use crate::support::client::Client;
use crate::support::until;

const DOORS: [Rules; 2] = [Rules::Door, Rules::KubernetesDoor];
const MACHINES: [&str; 2] = ["127.0.0.2", "127.0.0.3"];

#[actix_rt::test]
async fn a_visitor_gets_everywhere_through_one_door() {
    for door in DOORS {
        goes_everywhere(&Fleet::start(door).await).await;
    }
}

async fn goes_everywhere(fleet: &Fleet) {
    let (browser, port) = (&fleet.browser, fleet.here.port);
    let door = |scheme: &str, machine: &str, port: u16| format!("{scheme}://{}/{machine}/{port}", browser.host);

    // The session server tells clients the way through the door, and asks the servers themselves.
    let page = browser.get("/monitor").await.text();
    let status = browser.get("/status").await.json();
    for (number, machine) in MACHINES.into_iter().enumerate() {
        let monitor = format!("{}/monitor", door("https", machine, port));
        assert!(page.contains(&monitor), "{monitor} is not in {page}");
        assert_eq!(status["servers"][number]["monitor"], monitor);
        assert_eq!(status["servers"][number]["address"], format!("{machine}:{port}"));
        assert_eq!(browser.ask(&monitor, &[]).await.status, 200);
        let log = [&fleet.here, &fleet.there][number].log();
        let line = format!("simulation server  {monitor}   {}/client", door("wss", machine, port));
        assert!(log.lines().any(|one| one == line), "{line} is not in {log}");
    }
    let line = format!("session server     https://{0}/monitor   wss://{0}/session", browser.host);
    assert!(fleet.session.log().lines().any(|one| one == line), "{}", fleet.session.log());

    let mut session = browser.connect("/session").await;
    session.until("1").await;
    session.send(&arm()).await;
    let given = session.until("wss").await;
    assert!(MACHINES.iter().any(|machine| given == door("wss", machine, port)), "{given}");

    // A simulation on each machine; the web client appends /client, and derives the address of files from that of the stream.
    for machine in MACHINES {
        let mut client: Client = browser.open(&format!("{}/client", door("wss", machine, port))).await;
        client.send(&serde_json::json!({"start": {"url": arm()}}).to_string()).await;
        let stream = client.until("webots:").await;
        assert_eq!(stream, format!("webots:{}", door("wss", machine, port + 1)));
        let mut viewer = browser.open(&format!("{}/", door("wss", machine, port + 1))).await.with_scene().await;
        let file = browser.get(&format!("/{machine}/{}/worlds/textures/old%20wood.png?x=1", port + 1)).await;
        assert_eq!((file.status.as_u16(), file.text().as_str()), (200, "a picture"));
        assert_eq!(file.header("content-security-policy"), Some("sandbox allow-scripts"));
        client.leave().await;
        viewer.closed().await;
        until("Webots has ended", async || TcpStream::connect((machine, port + 1)).await.is_err()).await;
    }
}

#[actix_rt::test]
async fn who_is_lost_comes_back_through_the_door() {
    let fleet = Fleet::start(Rules::Door).await;
    let client = |machine: &str| format!("/{machine}/{}/client", fleet.here.port);
    let mut tokens = Vec::new();
    for machine in MACHINES {
        let mut lost = fleet.browser.connect(&client(machine)).await;
        lost.send(&serde_json::json!({"start": {"url": arm(), "resumable": true}}).to_string()).await;
        let stream = lost.until("webots:").await["webots:".len()..].to_owned();
        tokens.push((lost.token().await, stream));
        drop(lost);
    }
    // Each at its own machine only, and from another address.
    let browser = fleet.browser.at("127.0.0.9");
    for (number, machine) in MACHINES.into_iter().enumerate() {
        let mut stranger = browser.connect(&client(machine)).await.resume(&tokens[1 - number].0).await;
        assert_eq!(stranger.until("").await, "loading: Error: this simulation has ended");
        assert_eq!(stranger.closed().await, Some(1000));
        let (token, stream) = &tokens[number];
        let mut back = browser.connect(&client(machine)).await.resume(token).await;
        assert_eq!(back.until("webots:").await, format!("webots:{stream}"));
        let mut viewer = browser.open(&format!("{stream}/")).await;
        viewer.send("x3d;broadcast").await;
        viewer.until("scene load completed").await;
        // It counts once, here and for the session server.
        until("both servers say so", async || {
            let own = browser.get(&format!("/{machine}/{}/status", fleet.here.port)).await.json();
            let known = browser.get("/status").await.json()["servers"][number]["instances"].clone();
            own["instances"]["arrivals"] == 1 && own["simulations"].as_array().unwrap().len() == 1 && known["idle"] == 1
        })
        .await;
        back.close_with(1000).await;
        viewer.closed().await;
    }
}

#[actix_rt::test]
async fn the_door_leads_to_the_fleet_and_nowhere_else() {
    for door in DOORS {
        leads_nowhere_else(&Fleet::start(door).await).await;
    }
}

async fn leads_nowhere_else(fleet: &Fleet) {
    let (private, port) = (private_service(), fleet.here.port);
    for path in [
        // Another host: this machine, one of its names, one on the internet.
        format!("/127.0.0.1/{private}/"),
        format!("/127.0.0.1/{port}/"),
        format!("/localhost/{port}/"),
        format!("/127.0.0.2.example.org/{port}/"),
        format!("/127.0.0.22/{port}/"),
        format!("/1.1.1.1/{port}/"),
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
        format!("/127.0.0.2/{port}:{private}/"),
        format!("/127.0.0.2/{port}@127.0.0.1:{private}/"),
        format!("/127.0.0.2%40127.0.0.1/{port}/"),
        format!("/127.0.0.1%23127.0.0.2/{port}/"),
        format!("/%0a127.0.0.2/{port}/"),
        // The session server has no such path, and its port is not one of a simulation server.
        format!("/127.0.0.1/{}/status", fleet.session.port),
        format!("/{port}/"),
        // What is for administrators alone.
        format!("/127.0.0.2/{port}/drain"),
        format!("/127.0.0.2//{port}/drain"),
        format!("/127.0.0.2/{port}/%64rain"),
    ] {
        fleet.browser.finds_nothing(&path).await;
    }
}
