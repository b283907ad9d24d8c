//! Clients, watchers and viewers while a world is downloaded and read, at each level of isolation. A viewer that reaches
//! a Webots without a world crashes it.

use std::time::Duration;

use futures_util::future::join_all;

use super::deeds::Stage;
use super::network::levels;
use crate::simulation::scene::nothing_left;
use crate::support::{Builder, Client, DEMO, Server, WORLD, Webots, arm_at, demo_server, http, outcome};

/// Time between two viewers.
const STEP: Duration = Duration::from_millis(150);

/// A world with these options of the demo simulator.
fn slow(options: &str) -> String {
    WORLD.replacen('\n', &format!("\n#demo-simulator: {options}\n"), 1)
}

/// The scene, as a viewer receives it that requests the announced kind; nothing was on the console.
async fn sees_the_scene(client: &Client, url: &str) -> Client {
    let kind = client.heard.iter().rev().find_map(|text| text.strip_prefix("kind: "));
    let mut viewer = Client::connect(&format!("{url}/")).await;
    viewer.send(&format!("{};broadcast", kind.unwrap())).await;
    viewer.until("scene load completed").await;
    // What was on the console comes after the scene, and before the next answer.
    viewer.send("pause").await;
    viewer.until("paused by client").await;
    let console = viewer.heard.iter().find(|text| text.starts_with("std"));
    assert_eq!(console, None);
    viewer
}

/// Watches a simulation; returns the status of the page if it can't be watched.
async fn watch(server: &Server, id: &str) -> Result<Client, u16> {
    let page = http::get_with_password(&server.url(&format!("/watch?id={id}")), "a secret").await;
    if page.status != 200 {
        return Err(page.status.as_u16());
    }
    let page = page.text();
    let (_, rest) = page.split_once("data-stream=\"").unwrap();
    let path = rest.split_once('"').unwrap().0;
    let mut watcher = Client::connect(&server.websocket(&format!("/{path}"))).await;
    watcher.send("w3d;broadcast").await;
    Ok(watcher)
}

#[actix_rt::test]
async fn whoever_joins_a_world_that_is_being_loaded_gets_its_scene() {
    for (level, user, network) in levels() {
        for streaming in ["direct", "relay"] {
            let stage = Stage::new();
            let webots = Webots::launcher();
            let files = [
                // Long enough that a busy machine asks while it downloads.
                ("worlds/a.wbt", &*slow("download=2 load=1.5")),
                ("worlds/b.wbt", &*slow("load=1.5")),
            ];
            stage.forge.commit("lab/arm", "slow", &files);
            // Each load takes longer than a running Webots may hang.
            let builder = stage
                .builder(&webots, level)
                .before(user)
                .set("sandbox.network", network)
                .set("streaming", streaming)
                .set("timing.heartbeat", 0.1)
                .set("hangLimit", 1);
            whole_way(builder).await;
        }
    }
}

async fn whole_way(builder: Builder) {
    let server = builder.start().await;
    let mut client = Client::connect(&server.websocket("/client")).await;
    let request = serde_json::json!({"start": {"url": arm_at("slow"), "resumable": true}});
    client.send(&request.to_string()).await;
    client.until("session: ").await;
    // Nobody can watch before there is a world.
    let mut watchers = Vec::new();
    while !client.heard.iter().any(|text| text.starts_with("webots:")) {
        watchers.push(watch(&server, client.id()).await);
        client.next_within(STEP).await;
    }
    let url = client.heard.last().unwrap()["webots:".len()..].to_owned();
    let early = watchers.iter().filter(|watcher| watcher.is_err()).count();
    assert!(early > 3, "{early} of {}", watchers.len());
    for watcher in watchers.into_iter().flatten() {
        let mut watcher = watcher;
        watcher.until("scene load completed").await;
    }
    let progress = client
        .heard
        .iter()
        .find(|text| text.starts_with("loading: Webots: Downloading assets: "));
    assert!(progress.is_some(), "{:?}", client.heard);
    let mut viewer = sees_the_scene(&client, &url).await;

    // Webots is busy while it reads another world.
    let token = client.token().await;
    viewer.send("load:worlds/b.wbt").await;
    viewer.until("delete world").await;
    let mut others = Vec::new();
    for _ in 0..3 {
        others.push(watch(&server, client.id()).await.unwrap());
        actix_rt::time::sleep(STEP).await;
    }
    drop((viewer, client));
    server.until_away(1).await;
    let mut client = Client::resuming(&server, &token).await;
    client.until("webots:").await;
    sees_the_scene(&client, &url).await;
    for mut other in others {
        other.until("scene load completed").await;
    }
    client.close_with(1000).await;
    nothing_left(&server, 2).await;
}

#[actix_rt::test]
async fn whoever_joins_through_the_server_while_another_world_is_downloaded_gets_its_scene() {
    let builder = demo_server(1)
        .set("streaming", "relay")
        .set("adminPassword", "a secret");
    let server = builder.start().await;
    let files = [("worlds/a.wbt", WORLD), ("worlds/b.wbt", &*slow("download=3 load=0.5"))];
    server.forge().commit("lab/arm", "two", &files);
    let mut client = Client::start(&server, &arm_at("two")).await;
    let url = client.until("webots:").await["webots:".len()..].to_owned();
    let mut viewer = sees_the_scene(&client, &url).await;
    viewer.send("load:worlds/b.wbt").await;
    viewer.until("delete world").await;
    let mut watcher = watch(&server, client.id()).await.unwrap();
    sees_the_scene(&client, &url).await;
    watcher.until("scene load completed").await;
}

#[actix_rt::test]
async fn of_a_hundred_starts_none_crashes() {
    let server = demo_server(10).set("waitingLine", 100).start().await;
    let world = slow("download=0.1 load=0.1");
    server.forge().commit("lab/arm", "slow", &[("worlds/a.wbt", &world)]);
    let start = async || {
        let mut client = Client::start(&server, &arm_at("slow")).await;
        let url = client.within("webots:", Duration::from_mins(2)).await["webots:".len()..].to_owned();
        sees_the_scene(&client, &url).await;
        client.close_with(1000).await;
    };
    join_all((0..100).map(|_| start())).await;
    nothing_left(&server, 10).await;
}

#[actix_rt::test]
async fn a_release_that_answers_no_controller_is_ready_at_its_first_heartbeat() {
    let server = demo_server(1).set("timing.heartbeat", 0.6).start().await;
    // A controller would crash it, and so would a viewer before the heartbeat.
    let world = slow("download=0.4").replace("R2025a", "R2022b");
    server.forge().commit("lab/arm", "old", &[("worlds/a.wbt", &world)]);
    let mut client = Client::start(&server, &arm_at("old")).await;
    let url = client.until("webots:").await["webots:".len()..].to_owned();
    sees_the_scene(&client, &url).await;
}

#[actix_rt::test]
async fn the_time_limit_of_a_launch_includes_the_load() {
    let server = demo_server(1).set("timing.launch", 1).start().await;
    for (branch, options) in [("download", "download=60"), ("load", "load=60")] {
        let world = slow(options);
        server.forge().commit("lab/arm", branch, &[("worlds/a.wbt", &world)]);
        let told = outcome(&server, &arm_at(branch)).await;
        assert!(
            told.contains("Webots did not become ready within 1 seconds"),
            "{branch}: {told}"
        );
    }
}

/// Ends three seconds after it began to listen, if its world contains `crash`; never listens, if it contains `never`.
fn misbehaving() -> Webots {
    Webots::script(&format!(
        "for world; do case $world in --port=*) port=${{world#--port=}};; esac; done
         grep -q never \"$world\" && exec sleep 1000
         {DEMO} \"$@\" & child=$!
         if grep -q crash \"$world\"; then
             until (exec 3<>/dev/tcp/127.0.0.1/$port) 2>/dev/null; do sleep 0.1; done
             sleep 3; kill -KILL $child; exit 3
         fi
         wait $child"
    ))
}

#[actix_rt::test]
async fn whether_webots_has_listened_decides_who_is_to_blame() {
    // R2022b answers no requests, and a world that is being read answers none.
    let cases = ["R2022b", "R2025a"].map(|release| {
        [
            ("never", "launch-failed", release),
            ("stay", "load-timeout", release),
            ("crash", "load-failed", release),
        ]
    });
    for (level, user, network) in levels() {
        let stage = Stage::new();
        let webots = misbehaving();
        let builder = stage.builder(&webots, level).before(user);
        let server = builder
            .set("sandbox.network", network)
            .set("timing.launch", 25)
            .set("maxConnections", 6)
            .start()
            .await;
        let start = async |(deed, code, release): (&str, &str, &str)| {
            let world = format!("{}# {deed}\n", slow("load=60")).replace("R2025a", release);
            let branch = format!("{deed}-{release}");
            stage.forge.commit("lab/arm", &branch, &[("worlds/a.wbt", &world)]);
            let mut client = Client::start(&server, &arm_at(&branch)).await;
            client.patiently("loading: Error:").await;
            let told = client.reason();
            assert_eq!(told["code"], code, "{level}, {network}, {branch}: {told}");
        };
        join_all(cases.concat().into_iter().map(start)).await;
        assert_eq!(server.status().await["failedStarts"], 2, "{level}, {network}");
    }
}

/// Begins to listen after as many seconds as its world says, and crashes a tenth of a second later.
fn crashing_soon() -> Webots {
    Webots::script(&format!(
        "for world; do case $world in --port=*) port=${{world#--port=}};; esac; done
         sleep \"$(sed -n 's/^# listens after //p' \"$world\")\"
         {DEMO} \"$@\" & child=$!
         until (exec 3<>/dev/tcp/127.0.0.1/$port) 2>/dev/null; do sleep 0.01; done
         sleep 0.1; kill -KILL $child; exit 3"
    ))
}

#[actix_rt::test]
async fn on_a_quiet_machine_a_world_that_crashes_webots_soon_after_it_listens_is_to_blame() {
    let delays = ["2", "2.4", "2.8", "3.2", "3.6", "4"];
    let cases = ["R2022b", "R2025a"].map(|release| delays.map(|delay| (release, delay)));
    for (level, user, network) in levels() {
        let stage = Stage::new();
        let webots = crashing_soon();
        let builder = stage.builder(&webots, level).before(user);
        let server = builder
            .set("sandbox.network", network)
            .set("maxConnections", 12)
            .start()
            .await;
        let start = async |(release, delay): (&str, &str)| {
            let world = format!("{}# listens after {delay}\n", slow("load=60")).replace("R2025a", release);
            let branch = format!("{release}-{delay}");
            stage.forge.commit("lab/arm", &branch, &[("worlds/a.wbt", &world)]);
            let mut client = Client::start(&server, &arm_at(&branch)).await;
            client.patiently("loading: Error:").await;
            let told = client.reason();
            assert_eq!(told["code"], "load-failed", "{level}, {network}, {branch}: {told}");
        };
        join_all(cases.concat().into_iter().map(start)).await;
        assert_eq!(server.status().await["failedStarts"], 0, "{level}, {network}");
    }
}
