//! Resuming: a client whose connection breaks gets its simulation back, and no other client does.

use std::time::{Duration, Instant};

use futures_util::future::join_all;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::json;

use super::life::quick;
use super::scene::nothing_left;
use crate::support::relay::{Mood, Relay};
use crate::support::wrapper::Wrapper;
use crate::support::{
    Builder, Client, DEMO, Server, Webots, arm, demo_server, http, instances_below, server_of, until,
};

const ENDED: &str = "loading: Error: this simulation has ended";
const TAKEN_OVER: &str = "loading: Error: this simulation was taken over elsewhere";

/// The error for a client that can't resume with this token.
async fn refused(server: &Server, token: &str) -> String {
    let mut client = Client::resuming(server, token).await;
    let told = client.until("").await;
    assert_eq!(client.closed().await, Some(1000), "{told}");
    // Its reason, and the error.
    assert_eq!(client.heard.len(), 2, "{:?}", client.heard);
    told
}

#[actix_rt::test]
async fn who_comes_back_finds_the_simulation_as_it_runs_at_each_level() {
    needs!("bwrap");
    for level in ["none", "sandbox"] {
        let server = quick(demo_server(2)).set("isolation", level).start().await;
        let (client, first) = Client::resumable(&server).await;
        let stream = format!("ws://127.0.0.1:{}/", server.port + 1);
        let mut viewer = Client::connect(&stream).await.with_running_scene().await;
        let before = server.simulations().await;
        let left = viewer.time().await;
        // Both connections break, as in a reload of the page.
        drop((client, viewer));
        server.until_away(1).await;
        // The server reads in Webots' output that it runs, perhaps later than the viewer sees it.
        until("it runs without anybody", async || {
            server.simulations().await[0]["stage"] == "running"
        })
        .await;

        let mut client = Client::resuming(&server, &first).await;
        let second = client.token().await;
        let heard: Vec<_> = client
            .heard
            .iter()
            .filter(|text| *text != ".")
            .map(String::as_str)
            .collect();
        assert_eq!(
            heard[0],
            format!("session: {}", server.simulations().await[0]["id"].as_str().unwrap())
        );
        let url = format!("webots:ws://localhost:{}", server.port + 1);
        assert_eq!(heard[2..5], ["kind: w3d", &url, "absence: 300"]);
        let rest: u64 = heard[1]["shutdownTimeout: ".len()..].parse().unwrap();
        assert!((7000..=7200).contains(&rest) && heard.len() == 6, "{heard:?}");
        assert_ne!(first, second);
        let mut viewer = Client::connect(&stream).await;
        viewer.send("w3d;broadcast").await;
        let back = viewer.time().await;
        assert!(back >= left, "it began anew: {left} {back}");
        viewer.until("real-time").await;
        while viewer.time().await <= back {}
        until("it is not away", async || {
            server.simulations().await[0]["awayUntil"].is_null()
        })
        .await;
        let after = server.simulations().await;
        assert_eq!(
            (&after[0]["pid"], &after[0]["id"]),
            (&before[0]["pid"], &before[0]["id"])
        );
        client.close_with(1000).await;
        nothing_left(&server, 2).await;
    }
}

/// A client that may come back from the first moment, and its token, which comes before anything else.
async fn early(server: &Server) -> (Client, String) {
    let mut client = Client::connect(&server.websocket("/client")).await;
    let start = json!({"start": {"url": arm(), "resumable": true, "early": true}});
    client.send(&start.to_string()).await;
    let token = client.token().await;
    let kinds: Vec<_> = client.heard.iter().filter_map(|text| text.split(':').next()).collect();
    assert_eq!(kinds, ["session", "absence", "resume"]);
    (client, token)
}

#[actix_rt::test]
async fn who_has_asked_for_it_comes_back_while_it_waits_and_while_it_starts() {
    let folder = tempfile::tempdir().unwrap();
    let gate = folder.path().join("gate");
    let script = format!(
        "until [ -e {} ]; do sleep 0.1; done\nexec {DEMO} \"$@\"",
        gate.display()
    );
    let builder = quick(server_of(Webots::script(&script), 1));
    // A sandbox has no gate.
    let server = builder.set("isolation", "none").start().await;
    let stage = async || server.simulations().await[0]["stage"].clone();
    let (first, _) = early(&server).await;
    let (mut client, token) = early(&server).await;
    client.until("queue: 0").await;
    let id = client.heard[0].clone();
    drop(client);
    server.until_away(1).await;
    // It keeps its position.
    let mut client = Client::resuming(&server, &token).await;
    let token = client.token().await;
    client.until("queue: 0").await;
    drop(client);
    server.until_away(1).await;
    // It is its turn while nobody is there.
    first.close_with(1000).await;
    until("it is launched", async || stage().await == "launching").await;
    let mut client = Client::resuming(&server, &token).await;
    let token = client.token().await;
    client.until("loading: webots is starting").await;
    drop(client);
    server.until_away(1).await;
    // It becomes ready while nobody is there.
    std::fs::write(&gate, "").unwrap();
    until("it is ready", async || stage().await == "idle").await;
    let mut client = Client::resuming(&server, &token).await;
    client.until("webots:").await;
    assert_eq!(client.heard[0], id);
    let last = client.token().await;
    assert_eq!(server.status().await["instances"]["arrivals"], 2);
    client.close_with(1000).await;
    nothing_left(&server, 1).await;
    assert_eq!(refused(&server, &last).await, ENDED);
}

#[actix_rt::test]
async fn who_comes_back_to_a_start_that_has_failed_hears_why() {
    let folder = tempfile::tempdir().unwrap();
    let gate = folder.path().join("gate");
    let script = format!("until [ -e {} ]; do sleep 0.1; done; exit 3", gate.display());
    let builder = quick(server_of(Webots::script(&script), 1));
    // A sandbox has no gate.
    let server = builder.set("isolation", "none").start().await;
    let (client, token) = early(&server).await;
    until("it is launched", async || {
        server.simulations().await[0]["stage"] == "launching"
    })
    .await;
    drop(client);
    server.until_away(1).await;
    std::fs::write(&gate, "").unwrap();
    until("it has failed", async || server.simulations().await.is_empty()).await;
    let mut client = Client::resuming(&server, &token).await;
    let told = client.until("loading: Error:").await;
    assert!(
        told.starts_with(&format!("{ENDED}: ")) && told.contains("code 3"),
        "{told}"
    );
    assert!(
        client.heard[0].contains(r#""code":"launch-failed""#),
        "{:?}",
        client.heard
    );
}

#[actix_rt::test]
async fn a_checkout_ends_with_its_simulation_although_its_client_may_come_back() {
    for command in ["ls-remote", "fetch", "checkout"] {
        let wrapper = Wrapper::git(&format!("case \" $* \" in *\" {command} \"*) exec sleep 600;; esac"));
        let builder = quick(demo_server(1)).env("PATH", &wrapper.path());
        let builder = builder.set("timing.checkout", 600).set("adminPassword", http::PASSWORD);
        let server = builder.start().await;
        let (client, token) = early(&server).await;
        let hanging = || instances_below(&server.folder).iter().any(|one| one.1 == "sleep 600");
        until("git hangs", async || hanging()).await;
        let stop = server.url(&format!("/simulations/{}/stop", client.id()));
        assert_eq!(http::post(&stop, Some(http::PASSWORD), "").await, 202, "{command}");
        nothing_left(&server, 1).await;
        let told = refused(&server, &token).await;
        let stopped = format!("{ENDED}: The administrator has stopped this simulation");
        assert_eq!(told, stopped, "{command}");
    }
}

#[actix_rt::test]
async fn a_client_that_waits_gets_the_slot_of_one_that_is_away_for_long() {
    let server = quick(demo_server(2)).set("timing.yieldAfter", 6.0).start().await;
    let (away, token) = Client::resumable(&server).await;
    drop(away);
    server.until_away(1).await;
    let since = Instant::now();
    // Another slot is free: nobody has to leave.
    let second = Client::ready(&server).await;
    while since.elapsed() < Duration::from_secs(8) {
        actix_rt::time::sleep(Duration::from_millis(100)).await;
        assert_eq!(server.simulations().await.len(), 2);
    }
    let third = Client::ready(&server).await;
    let mut late = Client::resuming(&server, &token).await;
    let told = late.until("loading: Error:").await;
    assert!(told.contains("Others wait for a place"), "{told}");
    // Who is away for a shorter time stays.
    third.close_with(1000).await;
    let (away, token) = Client::resumable(&server).await;
    drop(away);
    server.until_away(1).await;
    let mut waits = Client::start(&server, &arm()).await;
    waits.until("queue: 0").await;
    assert_eq!(server.simulations().await.len(), 3);
    Client::resuming(&server, &token).await.until("webots:").await;
    second.close_with(1000).await;
    waits.until("webots:").await;
}

#[actix_rt::test]
async fn a_token_works_once_and_its_client_alone_is_told_it() {
    let server = quick(demo_server(1)).start().await;
    let (mut first, one) = Client::resumable(&server).await;
    // The first connection is still open, as if the server had not noticed yet that its page was closed.
    let mut second = Client::resuming(&server, &one).await;
    let two = second.token().await;
    assert_eq!(first.until("loading: Error").await, TAKEN_OVER);
    assert_eq!(first.closed().await, Some(1000));
    assert_eq!(refused(&server, &one).await, TAKEN_OVER);
    for nonsense in [
        "",
        "x",
        &one[1..],
        &"0".repeat(48),
        &one.to_uppercase().replace('A', "Z"),
    ] {
        let told = refused(&server, nonsense).await;
        assert!([ENDED, TAKEN_OVER].contains(&told.as_str()), "{nonsense}: {told}");
    }
    // These attempts have changed nothing.
    let mut third = Client::resuming(&server, &two).await;
    assert_eq!(second.until("loading: Error").await, TAKEN_OVER);
    assert_eq!(server.status().await["instances"]["arrivals"], 1);
    let three = third.token().await;
    drop(third);
    server.until_away(1).await;
    // No page and no log contains a token, or its secret part.
    let mut told = server.log();
    for path in ["/status", "/monitor", "/metrics"] {
        told += &http::get(&server.url(path)).await.text();
    }
    assert!(told.contains("away"), "{told}");
    assert!(
        [&one, &two, &three].iter().all(|token| !told.contains(&token[16..])),
        "{told}"
    );
    let mut last = Client::resuming(&server, &three).await;
    last.token().await;
    last.close_with(1000).await;
    nothing_left(&server, 1).await;
    assert_eq!(refused(&server, &three).await, ENDED);
}

#[actix_rt::test]
async fn only_a_close_with_1000_ends_a_resumable_simulation_at_once() {
    let server = quick(demo_server(2)).start().await;
    for code in [1001, 3000, 1000] {
        let (client, token) = Client::resumable(&server).await;
        client.close_with(code).await;
        if code != 1000 {
            server.until_away(1).await;
            let mut client = Client::resuming(&server, &token).await;
            // A page that only ends its simulation waits for no answer.
            if code == 1001 {
                client.token().await;
            }
            client.close_with(1000).await;
        }
        nothing_left(&server, 2).await;
        assert_eq!(refused(&server, &token).await, ENDED);
    }
    let never = quick(demo_server(2)).set("timing.absence", 0).start().await;
    for (server, resumable) in [(&server, false), (&never, true)] {
        let mut client = Client::connect(&server.websocket("/client")).await;
        client
            .send(&json!({"start": {"url": arm(), "resumable": resumable}}).to_string())
            .await;
        client.until("webots:").await;
        client.until(".").await;
        assert!(
            !client
                .heard
                .iter()
                .any(|text| text.starts_with("resume") || text.starts_with("absence"))
        );
        drop(client);
        nothing_left(server, 2).await;
    }
}

#[actix_rt::test]
async fn a_client_behind_a_stalled_link_resumes_or_is_given_up() {
    let change = |builder: Builder| {
        builder
            .set("timing.ping", 0.2)
            .set("timing.silence", 3.0)
            .set("timing.absence", 1.5)
    };
    let server = change(quick(demo_server(1))).start().await;
    let relay = Relay::to(server.port).await;
    let through = format!("ws://127.0.0.1:{}/client", relay.port);
    let (mut lost, token) = Client::connect(&through).await.start_resumable().await;
    let pid = server.simulations().await[0]["pid"].clone();
    relay.set(Mood::Silent);
    // The server has not noticed the loss yet.
    let mut client = Client::resuming(&server, &token).await;
    let next = client.token().await;
    assert_eq!(server.simulations().await[0]["pid"], pid);
    relay.set(Mood::Open);
    lost.closed().await;
    client.until(".").await;
    drop(client);

    // Again through the link, which stays silent: after the timeouts of silence and absence nothing remains.
    let mut client = Client::connect(&through).await.resume(&next).await;
    let last = client.token().await;
    relay.set(Mood::Silent);
    server.until_away(1).await;
    nothing_left(&server, 1).await;
    assert_eq!(refused(&server, &last).await, ENDED);
}

#[actix_rt::test]
async fn who_comes_back_too_late_hears_why_it_has_ended() {
    // A silent Webots is not a lost connection.
    let server = quick(demo_server(1)).set("timing.heartbeat", 3600).start().await;
    let crash = async || {
        let webots = instances_below(&server.folder)
            .into_iter()
            .find(|one| one.1.contains("demo-simulator"));
        kill(Pid::from_raw(webots.unwrap().0), Signal::SIGKILL).unwrap();
        until("it has crashed", async || server.simulations().await.is_empty()).await;
    };
    for is_silent in [false, true] {
        let relay = Relay::to(server.port).await;
        let client = Client::connect(&format!("ws://127.0.0.1:{}/client", relay.port)).await;
        let (mut client, token) = client.start_resumable().await;
        client.until("absence: ").await;
        // A client whose connection only seems to be open gets the same answer.
        if is_silent {
            relay.set(Mood::Silent);
        } else {
            drop(client);
            server.until_away(1).await;
        }
        crash().await;
        let told = refused(&server, &token).await;
        assert!(told.starts_with(&format!("{ENDED}: Webots ")), "{told}");
        nothing_left(&server, 1).await;
    }
}

#[actix_rt::test]
async fn a_server_that_drains_waits_for_who_is_away() {
    let mut server = quick(demo_server(4)).set("timing.absence", 10.0).start().await;
    let (stays, _) = Client::resumable(&server).await;
    let (comes, token) = Client::resumable(&server).await;
    drop((stays, comes));
    server.until_away(2).await;
    server.signal(Signal::SIGUSR1);
    until("it drains", async || server.status().await["draining"] == true).await;
    let mut client = Client::resuming(&server, &token).await;
    client.token().await;
    until("the other has ended", async || server.simulations().await.len() == 1).await;
    client.until(".").await;
    client.close_with(1000).await;
    assert_eq!(server.ended().await, Some(0));
    assert!(instances_below(&server.folder).is_empty());
}

#[actix_rt::test]
async fn a_server_that_stops_leaves_nothing_of_who_is_away() {
    let mut server = quick(demo_server(1)).start().await;
    let (client, _) = Client::resumable(&server).await;
    drop(client);
    server.until_away(1).await;
    let asked = Instant::now();
    server.stops().await;
    assert!(asked.elapsed() < Duration::from_secs(10), "{:?}", asked.elapsed());
    assert!(instances_below(&server.folder).is_empty());
    assert!(!server.log().contains("have not ended in time"));
}

#[actix_rt::test]
async fn who_resumes_counts_for_the_first_address() {
    let change = |builder: Builder| {
        let builder = builder
            .set("trustedProxies", json!(["127.0.0.1"]))
            .set("maxPlacesPerAddress", 1);
        builder.set("allowedOrigins", json!(["https://fleet.example.org"]))
    };
    let server = change(quick(demo_server(2))).start().await;
    let at = async |address| Client::from_address(&server, address).await.unwrap();
    let (client, token) = at("192.0.2.2").await.start_resumable().await;
    drop(client);
    server.until_away(1).await;
    let forbidden = Client::with_headers(&server.websocket("/client"), &[("origin", "https://evil.example.org")]).await;
    assert_eq!(forbidden.err(), Some(403));
    // It may be resumed from another address, but still counts for the first one.
    let mut client = at("192.0.2.3").await.resume(&token).await;
    client.token().await;
    let mut second = at("192.0.2.2").await.asking(&arm()).await;
    second.until("queue:").await;
    drop(second);
    client.close_with(1000).await;
}

#[actix_rt::test]
async fn a_whole_class_resumes_its_simulations() {
    const CLASS: usize = 50;
    let change = |builder: Builder| builder.set("timing.launch", 60).set("timing.heartbeat", 2);
    let server = change(quick(demo_server(2 * u16::try_from(CLASS).unwrap())))
        .start()
        .await;
    let mut class = Vec::new();
    for _ in 0..CLASS / 10 {
        class.extend(join_all((0..10).map(|_| Client::resumable(&server))).await);
    }
    let pids = async || {
        let mut pids: Vec<_> = server
            .simulations()
            .await
            .iter()
            .map(|one| one["pid"].as_i64().unwrap())
            .collect();
        pids.sort_unstable();
        pids
    };
    let before = pids().await;
    let tokens: Vec<String> = class.into_iter().map(|(_, token)| token).collect();
    server.until_away(CLASS).await;
    let back = Instant::now();
    let class = join_all(tokens.iter().map(async |token| {
        let mut client = Client::resuming(&server, token).await;
        client.token().await;
        client
    }))
    .await;
    println!("{CLASS} came back within {:?}", back.elapsed());
    assert!(back.elapsed() < Duration::from_secs(30), "{:?}", back.elapsed());
    assert_eq!(pids().await, before);
    let status = server.status().await;
    assert_eq!(status["instances"]["arrivals"], CLASS);
    join_all(class.into_iter().map(|client| client.close_with(1000))).await;
    nothing_left(&server, 2 * u16::try_from(CLASS).unwrap()).await;
}
