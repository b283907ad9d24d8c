//! Coming back: a client whose connection breaks finds its simulation again, and nobody else does.

use std::time::{Duration, Instant};

use futures_util::future::join_all;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};

use super::life::quick;
use super::scene::{DEMO, arm, instance_folders, nothing_left};
use crate::support::client::Client;
use crate::support::git::Forge;
use crate::support::program::{Builder, Server, simulation_server};
use crate::support::relay::{Mood, Relay};
use crate::support::webots::{Webots, instances_below};
use crate::support::{http, until};

pub(super) const ENDED: &str = "loading: Error: this simulation has ended";
const TAKEN_OVER: &str = "loading: Error: this simulation was taken over elsewhere";

/// A server, and what it needs.
pub(super) struct Stage {
    pub(super) server: Server,
    _parts: (Forge, Webots),
}

impl Stage {
    pub(super) async fn new(places: u16, change: impl FnOnce(Builder) -> Builder) -> Self {
        let (forge, webots) = (Forge::with_arm(), Webots::launcher());
        let builder = quick(simulation_server(&webots.path(), forge.path(), places));
        Self { server: change(builder).start().await, _parts: (forge, webots) }
    }

    pub(super) async fn simulations(&self) -> Vec<Value> {
        http::get(&self.server.url("/status")).await.json()["simulations"].as_array().unwrap().clone()
    }

    /// Waits until so many simulations wait for their clients.
    pub(super) async fn until_away(&self, count: usize) {
        until(&format!("{count} are away"), async || {
            self.simulations().await.iter().filter(|one| one["awayUntil"].is_u64()).count() == count
        })
        .await;
    }

    pub(super) async fn start(&self) -> (Client, String) {
        start(Client::connect(&self.server.websocket("/client")).await).await
    }

    pub(super) async fn resume(&self, token: &str) -> Client {
        resume(Client::connect(&self.server.websocket("/client")).await, token).await
    }

    /// What somebody with this token is told who can't come back.
    pub(super) async fn refused(&self, token: &str) -> String {
        let mut client = self.resume(token).await;
        let told = client.until("").await;
        assert_eq!(client.closed().await, Some(1000), "{told}");
        assert_eq!(client.heard.len(), 1, "{:?}", client.heard);
        told
    }
}

/// Starts a simulation that this client can come back to, and returns the token.
async fn start(mut client: Client) -> (Client, String) {
    client.send(&json!({"start": {"url": arm(), "resumable": true}}).to_string()).await;
    client.until("webots:").await;
    let token = token(&mut client).await;
    (client, token)
}

pub(super) async fn token(client: &mut Client) -> String {
    client.until("resume: ").await["resume: ".len()..].to_owned()
}

async fn resume(mut client: Client, token: &str) -> Client {
    client.send(&json!({ "resume": token }).to_string()).await;
    client
}

/// The next simulated time that a viewer is told.
pub(super) async fn time(viewer: &mut Client) -> f64 {
    let update = viewer.until("application/json:").await;
    serde_json::from_str::<Value>(&update["application/json:".len()..]).unwrap()["time"].as_f64().unwrap()
}

#[actix_rt::test]
async fn who_comes_back_finds_the_simulation_as_it_runs_at_each_level() {
    for level in ["none", "sandbox"] {
        let stage = Stage::new(2, |builder| builder.set("isolation", level)).await;
        let (client, first) = stage.start().await;
        let stream = format!("ws://127.0.0.1:{}/", stage.server.port + 1);
        let mut viewer = Client::connect(&stream).await;
        viewer.send("x3d").await;
        viewer.until("scene load completed").await;
        viewer.send("real-time:-1").await;
        viewer.until("real-time").await;
        let before = stage.simulations().await;
        let left = time(&mut viewer).await;
        // Both connections break, as with a reload.
        drop((client, viewer));
        stage.until_away(1).await;
        assert_eq!(stage.simulations().await[0]["stage"], "running");

        let mut client = stage.resume(&first).await;
        let second = token(&mut client).await;
        let heard: Vec<_> = client.heard.iter().filter(|text| *text != ".").map(String::as_str).collect();
        assert_eq!(heard[0], format!("session: {}", stage.simulations().await[0]["id"].as_str().unwrap()));
        assert_eq!(heard[2..4], [&format!("webots:ws://localhost:{}", stage.server.port + 1), "absence: 60"]);
        let rest: u64 = heard[1]["shutdownTimeout: ".len()..].parse().unwrap();
        assert!((7000..=7200).contains(&rest) && heard.len() == 5, "{heard:?}");
        assert_ne!(first, second);
        let mut viewer = Client::connect(&stream).await;
        viewer.send("x3d;broadcast").await;
        let back = time(&mut viewer).await;
        assert!(back >= left, "it began anew: {left} {back}");
        viewer.until("real-time").await;
        while time(&mut viewer).await <= back {}
        until("it is not away", async || stage.simulations().await[0]["awayUntil"].is_null()).await;
        let after = stage.simulations().await;
        assert_eq!((&after[0]["pid"], &after[0]["id"]), (&before[0]["pid"], &before[0]["id"]));
        client.close_with(1000).await;
        nothing_left(&stage.server, 2).await;
    }
}

#[actix_rt::test]
async fn a_token_works_once_and_the_later_client_keeps_the_simulation() {
    let stage = Stage::new(1, |builder| builder).await;
    let (mut first, one) = stage.start().await;
    // While the first connection is open: its page was closed in a way that nobody has noticed yet.
    let mut second = stage.resume(&one).await;
    let two = token(&mut second).await;
    assert_eq!(first.until("loading: Error").await, TAKEN_OVER);
    assert_eq!(first.closed().await, Some(1000));
    assert_eq!(stage.refused(&one).await, TAKEN_OVER);
    for nonsense in ["", "x", &one[1..], &"0".repeat(48), &one.to_uppercase().replace('A', "Z")] {
        let told = stage.refused(nonsense).await;
        assert!([ENDED, TAKEN_OVER].contains(&told.as_str()), "{nonsense}: {told}");
    }
    // Neither of them has changed anything.
    let mut third = stage.resume(&two).await;
    token(&mut third).await;
    assert_eq!(second.until("loading: Error").await, TAKEN_OVER);
    assert_eq!(http::get(&stage.server.url("/status")).await.json()["instances"]["arrivals"], 1);
    third.close_with(1000).await;
    nothing_left(&stage.server, 1).await;
    assert_eq!(stage.refused(&two).await, ENDED);
}

#[actix_rt::test]
async fn only_who_closes_with_1000_or_has_not_asked_for_more_ends_its_simulation_at_once() {
    let stage = Stage::new(2, |builder| builder).await;
    for code in [1001, 3000, 1000] {
        let (client, token) = stage.start().await;
        client.close_with(code).await;
        if code == 1000 {
            nothing_left(&stage.server, 2).await;
            assert_eq!(stage.refused(&token).await, ENDED);
        } else {
            stage.until_away(1).await;
            let mut client = stage.resume(&token).await;
            self::token(&mut client).await;
            client.close_with(1000).await;
            nothing_left(&stage.server, 2).await;
        }
    }
    let mut client = Client::start(&stage.server, &arm()).await;
    client.until("webots:").await;
    client.until(".").await;
    assert!(!client.heard.iter().any(|text| text.starts_with("resume") || text.starts_with("absence")));
    drop(client);
    nothing_left(&stage.server, 2).await;

    let stage = Stage::new(1, |builder| builder.set("timing.absence", 0)).await;
    let mut client = Client::connect(&stage.server.websocket("/client")).await;
    client.send(&json!({"start": {"url": arm(), "resumable": true}}).to_string()).await;
    client.until("webots:").await;
    client.until(".").await;
    assert!(!client.heard.iter().any(|text| text.starts_with("resume") || text.starts_with("absence")));
    drop(client);
    nothing_left(&stage.server, 1).await;
}

#[actix_rt::test]
async fn who_stays_away_leaves_nothing() {
    let stage = Stage::new(1, |builder| builder.set("timing.absence", 1.5)).await;
    let (client, token) = stage.start().await;
    drop(client);
    stage.until_away(1).await;
    let since = Instant::now();
    nothing_left(&stage.server, 1).await;
    assert!(since.elapsed() < Duration::from_secs(8), "{:?}", since.elapsed());
    assert_eq!(stage.refused(&token).await, ENDED);
}

#[actix_rt::test]
async fn a_client_behind_a_link_that_stalls_comes_back_another_way_or_is_given_up() {
    let change =
        |builder: Builder| builder.set("timing.ping", 0.2).set("timing.silence", 3.0).set("timing.absence", 1.5);
    let stage = Stage::new(1, change).await;
    let relay = Relay::to(stage.server.port).await;
    let through = format!("ws://127.0.0.1:{}/client", relay.port);
    let (mut lost, token) = start(Client::connect(&through).await).await;
    let pid = stage.simulations().await[0]["pid"].clone();
    relay.set(Mood::Silent);
    // The server has not noticed anything.
    let mut client = stage.resume(&token).await;
    let next = self::token(&mut client).await;
    assert_eq!(stage.simulations().await[0]["pid"], pid);
    relay.set(Mood::Open);
    lost.closed().await;
    client.until(".").await;
    drop(client);

    // Again through the link, which stays silent: after silence and absence nothing is left.
    let mut client = resume(Client::connect(&through).await, &next).await;
    let last = self::token(&mut client).await;
    relay.set(Mood::Silent);
    stage.until_away(1).await;
    nothing_left(&stage.server, 1).await;
    assert_eq!(stage.refused(&last).await, ENDED);
}

#[actix_rt::test]
async fn who_comes_back_too_late_hears_why_it_has_ended() {
    let stage = Stage::new(1, |builder| builder).await;
    let crash = async || {
        let webots = instances_below(&stage.server.folder).into_iter().find(|one| one.1.contains("demo-simulator"));
        kill(Pid::from_raw(webots.unwrap().0), Signal::SIGKILL).unwrap();
        until("it has crashed", async || stage.simulations().await.is_empty()).await;
    };
    let (client, token) = stage.start().await;
    drop(client);
    stage.until_away(1).await;
    crash().await;
    let told = stage.refused(&token).await;
    assert!(told.starts_with(&format!("{ENDED}: Webots ")), "{told}");

    // The same for one whose connection only seemed to be there.
    let relay = Relay::to(stage.server.port).await;
    let (_lost, token) = start(Client::connect(&format!("ws://127.0.0.1:{}/client", relay.port)).await).await;
    relay.set(Mood::Silent);
    crash().await;
    let told = stage.refused(&token).await;
    assert!(told.starts_with(&format!("{ENDED}: Webots ")), "{told}");
    nothing_left(&stage.server, 1).await;
}

#[actix_rt::test]
async fn who_is_away_while_its_simulation_fills_the_disk_hears_it() {
    let fill = "for n in $(seq 100); do head -c 500000 /dev/zero > file$n; done";
    let script = Webots::script(&format!("{DEMO} \"$@\" &\nuntil [ -e go ]; do sleep 0.05; done\n{fill}\nwait"));
    let stage = Stage::new(1, |builder| builder.set("webots", script.path().to_str()).set("limits.disk", 5)).await;
    let (client, token) = stage.start().await;
    drop(client);
    stage.until_away(1).await;
    std::fs::write(instance_folders(&stage.server.folder)[0].join("project/go"), "").unwrap();
    until("it has ended", async || stage.simulations().await.is_empty()).await;
    let told = stage.refused(&token).await;
    assert!(told.starts_with(&format!("{ENDED}: The simulation has written more than 5 MiB")), "{told}");
    nothing_left(&stage.server, 1).await;
}

#[actix_rt::test]
async fn a_server_that_drains_waits_for_who_is_away() {
    let mut stage = Stage::new(4, |builder| builder.set("timing.absence", 4.0)).await;
    let (stays, _) = stage.start().await;
    let (comes, token) = stage.start().await;
    drop((stays, comes));
    stage.until_away(2).await;
    stage.server.signal(Signal::SIGUSR1);
    until("it drains", async || http::get(&stage.server.url("/status")).await.json()["draining"] == true).await;
    let mut client = stage.resume(&token).await;
    self::token(&mut client).await;
    until("the other has ended", async || stage.simulations().await.len() == 1).await;
    client.until(".").await;
    client.close_with(1000).await;
    assert_eq!(stage.server.ended().await, Some(0));
    assert!(instances_below(&stage.server.folder).is_empty());
}

#[actix_rt::test]
async fn a_server_that_stops_leaves_nothing_of_who_is_away() {
    let mut stage = Stage::new(1, |builder| builder).await;
    let (client, _) = stage.start().await;
    drop(client);
    stage.until_away(1).await;
    let asked = Instant::now();
    stage.server.signal(Signal::SIGTERM);
    assert_eq!(stage.server.ended().await, Some(0));
    assert!(asked.elapsed() < Duration::from_secs(10), "{:?}", asked.elapsed());
    assert!(instances_below(&stage.server.folder).is_empty());
    assert!(!stage.server.log().contains("have not ended in time"));
}

#[actix_rt::test]
async fn those_who_are_away_hold_half_of_the_places() {
    let stage = Stage::new(4, |builder| builder).await;
    let mut tokens = Vec::new();
    for away in 1..=2 {
        let (client, token) = stage.start().await;
        drop(client);
        stage.until_away(away).await;
        tokens.push(token);
    }
    let (client, token) = stage.start().await;
    drop(client);
    tokens.push(token);
    until("one has ended", async || stage.simulations().await.len() == 2).await;
    let told = stage.refused(&tokens[0]).await;
    assert!(told.starts_with(&format!("{ENDED}: Too many simulations waited for their clients")), "{told}");
    for token in &tokens[1..] {
        let mut client = stage.resume(token).await;
        self::token(&mut client).await;
        client.close_with(1000).await;
    }
    nothing_left(&stage.server, 4).await;
}

#[actix_rt::test]
async fn who_goes_away_more_often_ends_no_simulation_of_others() {
    let stage = Stage::new(4, |builder| builder.set("trustedProxies", json!(["127.0.0.1"]))).await;
    let at = async |address| Client::try_from_address(&stage.server, address).await.unwrap();
    let mut tokens = Vec::new();
    for (away, address) in [(1, "192.0.2.1"), (2, "192.0.2.2"), (2, "192.0.2.2")] {
        let (client, token) = start(at(address).await).await;
        drop(client);
        stage.until_away(away).await;
        tokens.push(token);
    }
    until("one has ended", async || stage.simulations().await.len() == 2).await;
    let mut client = resume(at("192.0.2.1").await, &tokens[0]).await;
    token(&mut client).await;
    let told = resume(at("192.0.2.2").await, &tokens[1]).await.until("loading: Error:").await;
    assert!(told.contains("Too many simulations waited for their clients"), "{told}");
}

#[actix_rt::test]
async fn a_webots_that_says_nothing_is_no_lost_connection() {
    let stage = Stage::new(1, |builder| builder.set("timing.heartbeat", 3600)).await;
    let (mut client, _) = stage.start().await;
    client.until("absence: ").await;
}

#[actix_rt::test]
async fn who_comes_back_counts_for_the_address_that_has_asked_and_keeps_to_allowed_origins() {
    let change = |builder: Builder| {
        let builder = builder.set("trustedProxies", json!(["127.0.0.1"])).set("maxPlacesPerAddress", 1);
        builder.set("allowedOrigins", json!(["https://fleet.example.org"]))
    };
    let stage = Stage::new(2, change).await;
    let at = async |address| Client::try_from_address(&stage.server, address).await.unwrap();
    let (client, token) = start(at("192.0.2.2").await).await;
    drop(client);
    stage.until_away(1).await;
    let forbidden = stage.server.url("/client");
    let headers = [("origin", "https://evil.example.org"), ("upgrade", "websocket"), ("connection", "upgrade")];
    let answer = awc::Client::new().get(&forbidden).insert_header(headers[0]).insert_header(headers[1]);
    let answer = answer.insert_header(headers[2]).send().await.unwrap();
    assert_eq!(answer.status(), 403);
    // From elsewhere it may be had, and counts for the address that has asked for it.
    let mut client = resume(at("192.0.2.3").await, &token).await;
    self::token(&mut client).await;
    let mut second = at("192.0.2.2").await;
    second.send(&json!({"start": {"url": arm()}}).to_string()).await;
    second.until("queue:").await;
    drop(second);
    client.close_with(1000).await;
}

#[actix_rt::test]
async fn no_token_is_told_to_anybody_but_its_client() {
    let stage = Stage::new(1, |builder| builder).await;
    let (client, first) = stage.start().await;
    drop(client);
    stage.until_away(1).await;
    let mut client = stage.resume(&first).await;
    let second = token(&mut client).await;
    stage.refused(&first).await;
    drop(client);
    stage.until_away(1).await;
    let mut told = stage.server.log();
    for path in ["/status", "/monitor", "/metrics"] {
        told += &http::get(&stage.server.url(path)).await.text();
    }
    assert!(told.contains("away") && told.contains("webots_simulation_away 1"), "{told}");
    for token in [&first, &second] {
        // Nor its secret part alone.
        assert!(!told.contains(&token[16..]), "{told}");
    }
}

#[actix_rt::test]
async fn a_class_that_vanishes_at_once_comes_back_to_the_same_simulations() {
    const CLASS: usize = 100;
    let change = |builder: Builder| builder.set("timing.launch", 60).set("timing.heartbeat", 2);
    let stage = Stage::new(2 * u16::try_from(CLASS).unwrap(), change).await;
    let mut class = Vec::new();
    for ten in 0..CLASS / 10 {
        let started = join_all((0..10).map(|_| stage.start())).await;
        class.extend(started);
        assert_eq!(class.len(), 10 * (ten + 1));
    }
    let pids = async || {
        let mut pids: Vec<_> = stage.simulations().await.iter().map(|one| one["pid"].as_i64().unwrap()).collect();
        pids.sort_unstable();
        pids
    };
    let before = pids().await;
    let tokens: Vec<String> = class.into_iter().map(|(_, token)| token).collect();
    stage.until_away(CLASS).await;
    let back = Instant::now();
    let class = join_all(tokens.iter().map(async |token| {
        let mut client = stage.resume(token).await;
        self::token(&mut client).await;
        client
    }))
    .await;
    println!("{CLASS} came back within {:?}", back.elapsed());
    assert!(back.elapsed() < Duration::from_secs(30), "{:?}", back.elapsed());
    assert_eq!(pids().await, before);
    let status = http::get(&stage.server.url("/status")).await.json();
    assert_eq!(status["instances"]["arrivals"], CLASS);
    join_all(class.into_iter().map(|client| client.close_with(1000))).await;
    nothing_left(&stage.server, 2 * u16::try_from(CLASS).unwrap()).await;
}
