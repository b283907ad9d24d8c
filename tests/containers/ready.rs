//! Simulations in containers that are kept ready.

use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::{Value, json};

use super::daemon::{self, ask, containers, docker, dockerfile, of_service, own_images};
use super::deeds::doing;
use crate::support::{Builder, Client, SOON, Server, WORLD, arm, arm_at, ready_class, shared_library, until, world};

/// A server that keeps this many of a world ready, however busy the machine is.
fn keeping(builder: Builder, world: &str, count: u16) -> Builder {
    builder
        .set("readyLoad", 1000)
        .set("ready", json!([{"world": world, "count": count}]))
}

/// What a server reports of the world.
async fn kept(server: &Server) -> Value {
    server.status().await["ready"][0].clone()
}

/// Waits until this many are ready, the first of which may need an image.
async fn until_ready(server: &Server, count: u16) {
    let begin = Instant::now();
    while kept(server).await["ready"] != count {
        assert!(begin.elapsed() < 5 * SOON, "{:#}", kept(server).await);
        actix_rt::time::sleep(Duration::from_millis(100)).await;
    }
}

#[actix_rt::test]
async fn a_class_takes_containers_that_are_ready_and_starts_none() {
    let Some(_docker) = docker().await else { return };
    const CLASS: u16 = 3;
    let folder = tempfile::tempdir().unwrap();
    let start = || keeping(daemon::server(CLASS).folder(folder.path()), &arm(), CLASS).start();
    let running = |server: &Server| {
        let mut ids = of_service(server, "webots");
        ids.sort();
        ids
    };
    let mut killed = start().await;
    until_ready(&killed, CLASS).await;
    let of_killed = running(&killed);
    killed.signal(Signal::SIGKILL);
    killed.ended().await;
    // Once the class has all slots, none is started in place of those that it has taken.
    let mut server = start().await;
    until_ready(&server, CLASS).await;
    assert_eq!(server.simulations().await.len(), 0);
    until("nothing is left of the killed server", async || {
        containers(&server).len() == usize::from(CLASS)
    })
    .await;
    let before = running(&server);
    assert!(before.iter().all(|id| !of_killed.contains(id)));
    let mut clients = Vec::new();
    for _ in 0..CLASS {
        clients.push(Client::start(&server, &arm()).await);
    }
    for client in &mut clients {
        let url = client.until("webots:").await;
        let is_of_start = |text: &String| text.starts_with("loading:") || text.starts_with("progress:");
        assert!(!client.heard.iter().any(is_of_start), "{:?}", client.heard);
        let stream = format!("{}/", url.strip_prefix("webots:").unwrap());
        Client::connect(&stream).await.with_running_scene().await;
    }
    assert_eq!(running(&server), before, "no container was started");
    for client in clients {
        client.leave().await;
    }
    until("others are ready in their place", async || {
        kept(&server).await["ready"] == CLASS && server.simulations().await.is_empty()
    })
    .await;
    assert!(running(&server).iter().all(|id| !before.contains(id)));
    // The server drains: what nobody has ends at once, and it ends with its last client.
    let client = Client::ready(&server).await;
    server.signal(Signal::SIGUSR1);
    until("the client's is left", async || {
        server.status().await["instances"]["spare"] == 0 && containers(&server).len() == 1
    })
    .await;
    assert_eq!(server.simulations().await.len(), 1);
    client.leave().await;
    assert_eq!(server.ended().await, Some(0));
    until("no container is left", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn the_image_of_a_world_that_is_kept_ready_stays_between_its_times() {
    let Some(_docker) = docker().await else { return };
    let folder = tempfile::tempdir().unwrap();
    // Two images of these fit.
    let builder = daemon::server(1).set("container", json!({ "imagesSize": 50 }));
    for branch in ["a", "b", "c"] {
        let line = format!("RUN head -c 20M /dev/zero >/usr/local/{branch}");
        let files = [("Dockerfile", &*dockerfile(&line))];
        builder.forge().commit("lab/arm", branch, &files);
    }
    let builder = keeping(builder.folder(folder.path()), &arm_at("a"), 1);
    let server = builder.start().await;
    until_ready(&server, 1).await;
    let [first] = &*own_images(&server) else {
        panic!("{}", server.log())
    };
    let list = |entries: Value| server.reload(json!({ "ready": entries }));
    // Its time is over.
    list(json!([{"world": arm_at("a"), "count": 0}]));
    until("its container is gone", async || containers(&server).is_empty()).await;
    let build = async |branch| {
        let mut client = Client::start(&server, &arm_at(branch)).await;
        client.patiently("webots:").await;
        client.leave().await;
        until("its container is gone", async || containers(&server).is_empty()).await;
    };
    build("b").await;
    build("c").await;
    until("two fit", async || own_images(&server).len() == 2).await;
    assert!(own_images(&server).contains(first), "{}", server.log());
    // Once it is listed no longer, it is as any other that was used until now.
    list(json!([]));
    build("b").await;
    build("c").await;
    until("it is gone", async || !own_images(&server).contains(first)).await;
}

#[actix_rt::test]
async fn one_that_is_ready_and_takes_all_memory_is_told_once_and_replaced() {
    let Some(_docker) = docker().await else { return };
    let script = "until [ -e /tmp/go ]; do echo .; sleep 0.2; done\n\
        perl -e 'my @a; push @a, \"x\" x 1000000 while 1' & wait $!; exit 137";
    let server = keeping(doing(script), &arm(), 1).set("limits.memory", 64).start().await;
    let go = |container: &str| ask(&["exec", container, "touch", "/tmp/go"]);
    until_ready(&server, 1).await;
    let first = of_service(&server, "webots").remove(0);
    go(&first);
    until("it is told", async || {
        kept(&server).await["problem"]
            .as_str()
            .is_some_and(|why| why.contains("limits.memory"))
    })
    .await;
    until_ready(&server, 1).await;
    assert_eq!(kept(&server).await["problem"], Value::Null);
    assert_eq!(server.log().matches("can't be kept ready").count(), 1);
    assert_eq!(server.status().await["failedStarts"], 0);
    assert_eq!(
        containers(&server).len(),
        1,
        "nothing is left, and nothing is started twice"
    );
    let second = of_service(&server, "webots").remove(0);
    assert_ne!(second, first);
    // A client takes that one, with the same limit.
    let mut client = Client::ready(&server).await;
    go(&second);
    let told = client.until("loading: Error:").await;
    assert!(told.contains("limits.memory"), "{told}");
    let lines = || std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap_or_default();
    until("its end is recorded", async || lines().lines().count() >= 2).await;
    assert_eq!(lines().lines().count(), 2, "the heading, and one client: {}", lines());
}

#[actix_rt::test]
async fn a_world_that_only_shares_idle_time_stays_ready_at_any_load_and_is_started_at_a_low_one() {
    let Some(_docker) = docker().await else { return };
    let library = shared_library("simulation/nvml.c", "libnvidia-ml.so.1");
    let mark = library.path().join("busy");
    std::fs::write(&mark, "").unwrap();
    let other = world("other/world", "main", "worlds/a.wbt");
    // Of all processors, the load is never more than 100 %.
    let builder = daemon::server(2)
        .set("shareIdleTime", 100)
        .set("readyLoad", 1000)
        .set("timing.branches", 3600)
        .env("LD_LIBRARY_PATH", library.path().to_str().unwrap())
        .env("NVML_BUSY", mark.to_str().unwrap());
    builder
        .forge()
        .commit("other/world", "main", &[("worlds/a.wbt", WORLD)]);
    let server = builder.start().await;
    let load = async || server.status().await["load"].as_f64().unwrap();
    until("the load is high", async || load().await > 100.0).await;
    let list = json!([{"world": other, "count": 1}]);
    server.reload(json!({ "ready": list }));
    until("it is wanted", async || kept(&server).await["wanted"] == 1).await;
    let starts = || server.log().matches(": is kept ready with").count();
    let stays_at = async |starts_before: usize, ready: u16| {
        for _ in 0..40 {
            actix_rt::time::sleep(Duration::from_millis(100)).await;
            let now = kept(&server).await;
            assert_eq!((&now["ready"], &now["problem"]), (&json!(ready), &Value::Null), "{now}");
        }
        assert_eq!(starts(), starts_before);
    };
    stays_at(0, 0).await;
    std::fs::remove_file(&mark).unwrap();
    until_ready(&server, 1).await;
    std::fs::write(&mark, "").unwrap();
    until("the load is high again", async || load().await > 100.0).await;
    stays_at(1, 1).await;
    // It ends, and none is started in its place before the load is low.
    ask(&["kill", &of_service(&server, "webots")[0]]);
    until("its end is told", async || kept(&server).await["problem"].is_string()).await;
    // Longer than the pause after its end.
    actix_rt::time::sleep(Duration::from_secs(4)).await;
    assert_eq!(starts(), 1);
    std::fs::remove_file(&mark).unwrap();
    until_ready(&server, 1).await;
    assert_eq!(kept(&server).await["problem"], Value::Null);
    server.reload(json!({"ready": []}));
    until("no container is left", async || containers(&server).is_empty()).await;
}

/// The figures of docs/ready.md: `tests/own_network.sh cargo test --test containers on_a_quiet_machine_a_class -- --nocapture`
/// prints them.
#[actix_rt::test]
async fn on_a_quiet_machine_a_class_finds_its_containers_ready() {
    let Some(_docker) = docker().await else { return };
    ready_class::compare("container", || daemon::server(ready_class::SLOTS)).await;
}
