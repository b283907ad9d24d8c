//! Simulations that are kept ready: clients take them at once, they take nothing from clients, and nothing of them stays.

use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};

use super::life::quick;
use super::readings::gpu_driver;
use super::scene::nothing_left;
use crate::support::clock::Clock;
use crate::support::disk::{self, Full};
use crate::support::wrapper::Wrapper;
use crate::support::{
    Builder, Client, DEMO, Server, WORLD, Webots, arm, demo_server, http, instance_folders_in, instances_below,
    server_of, skip, until, world,
};

/// A server that keeps this many of the world of [`arm`] ready, however busy the machine is.
fn keeping(builder: Builder, count: u32) -> Builder {
    let builder = builder.set("readyLoad", 1000).set("timing.branches", 0.5);
    quick(builder).set("ready", json!([{"world": arm(), "count": count}]))
}

/// What a server reports of the world of [`arm`].
async fn kept(server: &Server) -> Value {
    server.status().await["ready"][0].clone()
}

async fn until_ready(server: &Server, count: u32) {
    let are_ready = async || kept(server).await["ready"] == count;
    until(&format!("{count} are ready"), are_ready).await;
}

/// The processes that were started as Webots: the ids.
fn pids(server: &Server) -> Vec<i32> {
    let all = instances_below(&server.cache()).into_iter();
    let mut pids: Vec<i32> = all
        .filter(|(_, words)| words.contains("--batch"))
        .map(|(pid, _)| pid)
        .collect();
    pids.sort_unstable();
    pids
}

/// When a line of the log was written.
fn time_of(line: &str) -> jiff::SignedDuration {
    let time: jiff::Timestamp = line.split(' ').next().unwrap().parse().unwrap();
    time.as_duration()
}

async fn asking(server: &Server, start: Value) -> Client {
    let mut client = Client::connect(&server.websocket("/client")).await;
    client.send(&json!({ "start": start }).to_string()).await;
    client
}

#[actix_rt::test]
async fn a_client_takes_one_that_is_ready_and_starts_nothing() {
    needs!("bwrap");
    for level in ["none", "sandbox"] {
        let server = keeping(demo_server(4), 2)
            .set("isolation", level)
            .set("idleTimeout", 0.05)
            .start()
            .await;
        until_ready(&server, 2).await;
        let status = server.status().await;
        assert_eq!(status["simulations"], json!([]), "it is no client's");
        assert_eq!(
            (&status["instances"]["spare"], &status["instances"]["idle"]),
            (&json!(2), &json!(0))
        );
        // Twice as long as a simulation of a client may be paused.
        actix_rt::time::sleep(Duration::from_secs(6)).await;
        let before = pids(&server);
        let mut client = asking(
            &server,
            json!({"url": arm(), "mode": "w3d", "resumable": true, "name": "Anna"}),
        )
        .await;
        let token = client.token().await;
        let heard: Vec<_> = client.heard.iter().map(String::as_str).collect();
        assert_eq!(heard[1..3], ["shutdownTimeout: 7200", "kind: w3d"], "{heard:?}");
        assert!(
            heard[3].starts_with("webots:ws://localhost:") && heard[4] == "absence: 300",
            "{heard:?}"
        );
        let one = server.simulations().await.remove(0);
        assert!(before.contains(&i32::try_from(one["pid"].as_i64().unwrap()).unwrap()) || level == "sandbox");
        assert_eq!(server.status().await["instances"]["arrivals"], 1);
        // It is this client's as any other simulation: it can be seen, is resumed, and its limit of time begins now.
        let port = one["port"].as_u64().unwrap();
        let viewer = Client::connect(&format!("ws://127.0.0.1:{port}/"))
            .await
            .with_running_scene()
            .await;
        drop(client);
        let mut client = Client::resuming(&server, &token).await;
        client.token().await;
        drop(viewer);
        // Another one is started in its place, but not while others of its class may come.
        until_ready(&server, 2).await;
        let log = server.log();
        let is_started = |line: &&str| line.contains("is kept ready with");
        let taken = log.lines().find(|line| line.contains(": takes it")).unwrap();
        let pause = time_of(log.lines().rfind(is_started).unwrap()) - time_of(taken);
        assert!(pause.as_secs_f64() >= 3.0, "{pause}");
        client.close_with(1000).await;
        until("only those are left", async || {
            server.simulations().await.is_empty() && kept(&server).await["ready"] == 2
        })
        .await;
        let metrics = server.metrics().await;
        assert!(
            metrics.contains("webots_simulation_kept_ready{state=\"ready\"} 2"),
            "{metrics}"
        );
        assert!(
            metrics.contains("webots_simulation_starts_total{outcome=\"ready\"} 1"),
            "{metrics}"
        );
        assert!(server.monitor().await.contains("Kept ready: a.wbt"));
        let lines = std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap();
        assert_eq!(lines.lines().count(), 2, "the heading, and one client: {lines}");
    }
}

#[actix_rt::test]
async fn only_a_client_of_its_world_and_mode_takes_it() {
    let builder = keeping(demo_server(4), 1);
    builder.forge().commit("lab/arm", "main", &[("worlds/b.wbt", WORLD)]);
    let server = builder.start().await;
    until_ready(&server, 1).await;
    let before = pids(&server);
    let mut other = asking(&server, json!({"url": world("lab/arm", "main", "worlds/b.wbt")})).await;
    other.until("loading: webots is starting").await;
    other.until("webots:").await;
    // The demo simulator, started for it, has no video.
    let mut video = asking(&server, json!({"url": arm(), "mode": "mjpeg"})).await;
    video.until("loading: webots is starting").await;
    assert!(video.until("reason: ").await.contains("launch-failed"));
    assert!(before.iter().all(|pid| pids(&server).contains(pid)));
    assert_eq!(kept(&server).await["ready"], 1);
}

#[actix_rt::test]
async fn clients_get_the_slots_of_those_that_are_ready_in_any_state() {
    // The second is a Webots that never gets ready.
    for state in ["idle", "launching"] {
        let builder = keeping(server_of(Webots::that_is(state), 2), 2);
        builder.forge().commit("lab/arm", "main", &[("worlds/b.wbt", WORLD)]);
        let server = builder.start().await;
        until("all slots are taken", async || {
            server.status().await["instances"]["spare"] == 2
        })
        .await;
        let other = world("lab/arm", "main", "worlds/b.wbt");
        let mut first = Client::start(&server, &other).await;
        let mut second = Client::start(&server, &other).await;
        for client in [&mut first, &mut second] {
            client.until("shutdownTimeout").await;
        }
        let status = server.status().await;
        assert_eq!(
            (&status["instances"]["spare"], &status["ready"][0]["wanted"]),
            (&json!(0), &json!(2))
        );
        // Nobody is ended for one that could be kept ready, also once others could be started again.
        actix_rt::time::sleep(Duration::from_secs(5)).await;
        assert_eq!(server.simulations().await.len(), 2);
        first.leave().await;
        until("one is kept again", async || {
            server.status().await["instances"]["spare"] == 1
        })
        .await;
    }
}

#[actix_rt::test]
async fn a_client_takes_even_one_that_starts() {
    let webots = Webots::script(&format!("sleep 3; exec {DEMO} \"$@\""));
    let server = keeping(server_of(webots, 1), 1).start().await;
    until("it starts", async || {
        kept(&server).await["starting"] == 1 && !pids(&server).is_empty()
    })
    .await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("shutdownTimeout: 7200").await;
    client.until("webots:").await;
    assert_eq!(server.log().matches(": started ").count(), 1);
    client.leave().await;
}

#[actix_rt::test]
async fn when_the_branch_moves_new_ones_come_before_old_ones_go() {
    let server = keeping(demo_server(3), 2).start().await;
    until_ready(&server, 2).await;
    let before = pids(&server);
    let changed = WORLD.replace("title \"Test\"", "title \"Changed\"");
    let commit = server.forge().commit("lab/arm", "main", &[("worlds/a.wbt", &changed)]);
    let mut fewest = usize::MAX;
    until("all are replaced", async || {
        let now = pids(&server);
        fewest = fewest.min(now.len());
        now.iter().all(|pid| !before.contains(pid)) && kept(&server).await["ready"] == 2
    })
    .await;
    assert!(fewest >= 2, "{fewest}");
    assert!(server.log().contains("its branch has moved"), "{commit}");
    let client = Client::ready(&server).await;
    let is_new = |folder: std::path::PathBuf| {
        std::fs::read_to_string(folder.join("project/worlds/a.wbt")).is_ok_and(|text| text.contains("Changed"))
    };
    until("all have the new commit", async || {
        let folders = instance_folders_in(&server.cache());
        folders.len() == 3 && folders.into_iter().all(is_new)
    })
    .await;
    // A branch that is gone: nobody would get that world.
    client.leave().await;
    until_ready(&server, 2).await;
    let bare = server.forge().path().join("lab/arm");
    crate::support::git::git(&bare, &["update-ref", "-d", "refs/heads/main"]);
    until("none is kept", async || {
        let kept = kept(&server).await;
        kept["ready"] == 0
            && kept["problem"]
                .as_str()
                .is_some_and(|why| why.contains("no branch, tag or commit"))
    })
    .await;
}

#[actix_rt::test]
async fn a_world_that_fails_is_told_once_and_ejects_nobody() {
    let builder = keeping(demo_server(2), 1);
    builder
        .forge()
        .commit("lab/arm", "main", &[("worlds/a.wbt", "no world\n")]);
    let server = builder.start().await;
    let problem = async || kept(&server).await["problem"].as_str().map(str::to_owned);
    until("it is told", async || {
        problem().await.is_some_and(|why| why.contains("is no world file"))
    })
    .await;
    until("it is tried again", async || {
        server.log().matches("is kept ready with").count() > 1
    })
    .await;
    assert_eq!(server.log().matches("can't be kept ready").count(), 1);
    assert_eq!(server.status().await["failedStarts"], 0);
    assert!(
        server
            .metrics()
            .await
            .contains("webots_simulation_kept_ready{state=\"failing\"} 1")
    );
    assert!(server.monitor().await.contains("is no world file"));
    // The branch moves: it is tried at once.
    server.forge().commit("lab/arm", "main", &[("worlds/a.wbt", WORLD)]);
    until_ready(&server, 1).await;
    assert_eq!(problem().await, None);
    // One that ends by itself is replaced, after a pause.
    kill(Pid::from_raw(pids(&server)[0]), Signal::SIGKILL).unwrap();
    until("its end is told", async || problem().await.is_some()).await;
    until_ready(&server, 1).await;
    assert_eq!(problem().await, None);
}

#[actix_rt::test]
async fn nothing_stays_after_any_end_of_the_server() {
    for signal in [Signal::SIGTERM, Signal::SIGUSR1, Signal::SIGKILL] {
        let folder = tempfile::tempdir().unwrap();
        let mut server = keeping(demo_server(3), 2).folder(folder.path()).start().await;
        until_ready(&server, 2).await;
        let cache = server.cache();
        server.signal(signal);
        let code = server.ended().await;
        assert_eq!(code, (signal != Signal::SIGKILL).then_some(0), "{signal}");
        until("no process is left", async || instances_below(&cache).is_empty()).await;
    }
}

#[actix_rt::test]
async fn a_list_is_read_again_and_worlds_are_kept_only_when_it_says_so() {
    let clock = Clock::new();
    let server = clock.of(keeping(demo_server(3), 1)).start().await;
    until_ready(&server, 1).await;
    let entry = |more: Value| {
        let mut entry = json!({"world": arm(), "count": 2});
        entry.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        json!({"ready": [entry]})
    };
    let in_an_hour = std::time::SystemTime::now() + Duration::from_hours(1);
    let in_an_hour = humantime::format_rfc3339_seconds(in_an_hour).to_string();
    server.reload(entry(json!({ "until": in_an_hour })));
    until_ready(&server, 2).await;
    clock.set(2 * 3600);
    until("the time is over", async || {
        server.status().await["instances"]["spare"] == 0
    })
    .await;
    nothing_left(&server, 3).await;
    clock.set(0);
    until_ready(&server, 2).await;
    server.reload(json!({"ready": "nonsense"}));
    until("the mistake is told", async || {
        server.log().contains("was not read again")
    })
    .await;
    assert_eq!(kept(&server).await["ready"], 2);
    server.reload(json!({"ready": []}));
    until("none is kept", async || {
        server.status().await["instances"]["spare"] == 0
    })
    .await;
    assert_eq!(server.status().await["ready"], json!([]));
    // Nothing is in a client's way.
    let client = Client::ready(&server).await;
    client.leave().await;
    nothing_left(&server, 3).await;
    assert!(http::get(&server.url("/health")).await.text().contains("ok"));
}

#[actix_rt::test]
async fn while_a_remote_is_away_others_are_started_and_its_return_is_seen() {
    let server = keeping(demo_server(3), 1).start().await;
    until_ready(&server, 1).await;
    let forge = server.forge().path();
    let repository = forge.join("lab/arm");
    let elsewhere = forge.join("elsewhere");
    std::fs::rename(&repository, &elsewhere).unwrap();
    let is_failing = async || kept(&server).await["problem"].is_string();
    until("it is told", is_failing).await;
    // A client takes it, and another one is started in its place.
    let before = pids(&server);
    let client = Client::ready(&server).await;
    until("there is another one", async || {
        kept(&server).await["ready"] == 1 && pids(&server) != before
    })
    .await;
    std::fs::rename(&elsewhere, &repository).unwrap();
    until("it is no problem any more", async || !is_failing().await).await;
    assert_eq!(server.log().matches("can't be read").count(), 1);
    client.leave().await;
}

#[actix_rt::test]
async fn a_remote_is_asked_at_once_for_a_world_that_is_wanted_from_now_on() {
    let builder = keeping(demo_server(4), 1).set("timing.branches", 3600);
    builder.forge().commit("lab/arm", "main", &[("worlds/b.wbt", WORLD)]);
    let server = builder.start().await;
    until_ready(&server, 1).await;
    let entry = |world: &str, count: u32| json!({"world": world, "count": count});
    // Another world of the same repository.
    let other = world("lab/arm", "main", "worlds/b.wbt");
    server.reload(json!({"ready": [entry(&arm(), 1), entry(&other, 1)]}));
    until("the other is ready", async || {
        server.status().await["ready"][1]["ready"] == 1
    })
    .await;
    // While none is wanted, the branch moves.
    server.reload(json!({"ready": [entry(&arm(), 0)]}));
    until("none is kept", async || {
        server.status().await["instances"]["spare"] == 0
    })
    .await;
    let changed = WORLD.replace("title \"Test\"", "title \"Changed\"");
    server.forge().commit("lab/arm", "main", &[("worlds/a.wbt", &changed)]);
    server.reload(json!({"ready": [entry(&arm(), 1)]}));
    until_ready(&server, 1).await;
    for folder in instance_folders_in(&server.cache()) {
        let text = std::fs::read_to_string(folder.join("project/worlds/a.wbt")).unwrap();
        assert!(text.contains("Changed"), "{text}");
    }
}

#[actix_rt::test]
async fn what_is_kept_ready_gives_way_to_memory() {
    let library = gpu_driver();
    let mark = library.path().join("mark");
    let server = keeping(demo_server(3), 2)
        .env("LD_LIBRARY_PATH", library.path().to_str().unwrap())
        .env("NVML_FULL", mark.to_str().unwrap())
        .start()
        .await;
    until_ready(&server, 2).await;
    std::fs::write(&mark, "").unwrap();
    until("none is left", async || {
        server.status().await["instances"]["spare"] == 0
    })
    .await;
    let starts = || server.log().matches(": is kept ready with").count();
    let before = starts();
    actix_rt::time::sleep(Duration::from_secs(3)).await;
    assert_eq!(starts(), before, "none is started only to end");
    // A person is served.
    let client = Client::ready(&server).await;
    std::fs::remove_file(&mark).unwrap();
    until_ready(&server, 2).await;
    client.leave().await;
}

#[actix_rt::test]
async fn on_a_full_disk_what_is_ready_stays_and_none_is_started() {
    disk::hide_mounts_from_others();
    let folder = tempfile::tempdir().unwrap();
    let small = folder.path().join("small");
    if !disk::small_disk(&small, 64) {
        return skip("only root may mount one");
    }
    let server = keeping(demo_server(3), 2)
        .set("diskReserve", 8)
        .set("isolation", "none")
        .folder(&small)
        .start()
        .await;
    until_ready(&server, 2).await;
    let filler = Full::at(&small);
    until("the disk is full", async || server.health().await.0 == 503).await;
    let ended = pids(&server)[0];
    kill(Pid::from_raw(ended), Signal::SIGKILL).unwrap();
    until_ready(&server, 1).await;
    let starts = || server.log().matches(": is kept ready with").count();
    let before = starts();
    // Longer than the first pause after its end.
    actix_rt::time::sleep(Duration::from_secs(4)).await;
    let one = kept(&server).await;
    assert_eq!((&one["ready"], &one["starting"]), (&json!(1), &json!(0)), "{one}");
    assert_eq!(starts(), before, "none is started only to fail");
    drop(filler);
    until_ready(&server, 2).await;
}

#[actix_rt::test]
async fn a_remote_is_asked_once_in_each_interval_for_all_its_worlds_and_clients() {
    let git = Wrapper::git("");
    let builder = keeping(demo_server(6), 1)
        .set("timing.branches", 3)
        .env("PATH", &git.path());
    builder.forge().commit("lab/arm", "main", &[("worlds/b.wbt", WORLD)]);
    let entry = |world: String| json!({"world": world, "count": 2});
    let list = [entry(arm()), entry(world("lab/arm", "main", "worlds/b.wbt"))];
    let server = builder.set("ready", json!(list)).start().await;
    let begin = Instant::now();
    until("all are ready", async || {
        let ready = server.status().await["ready"].clone();
        ready[0]["ready"] == 2 && ready[1]["ready"] == 2
    })
    .await;
    // Those that are taken are replaced.
    for _ in 0..4 {
        Client::ready(&server).await.leave().await;
        until_ready(&server, 2).await;
    }
    until("it is asked again", async || git.count("ls-remote") >= 3).await;
    let intervals = usize::try_from(begin.elapsed().as_secs() / 3).unwrap();
    let count = git.count("ls-remote");
    assert!(
        count <= 2 + intervals,
        "{count} in {intervals} intervals: {:?}",
        git.calls()
    );
}

/// How long clients of another world wait for their simulations, all at once, in the mean; `count` are kept ready.
async fn start_of_another_world(count: u32) -> Duration {
    let options = "#VRML_SIM R2025a utf8\n#demo-simulator: load=2\nWorldInfo { }\n";
    let builder = keeping(demo_server(4), count);
    builder.forge().commit("lab/arm", "main", &[("worlds/b.wbt", options)]);
    let server = builder.start().await;
    until("they are ready", async || kept(&server).await["ready"] == count).await;
    let other = world("lab/arm", "main", "worlds/b.wbt");
    // So that the repository is there in both cases.
    Client::start(&server, &other).await.until("loading: ").await;
    until("nothing else runs", async || {
        server.simulations().await.is_empty() && kept(&server).await["ready"] == count
    })
    .await;
    let begin = Instant::now();
    let clients = (0..4).map(|_| async {
        let mut client = Client::start(&server, &other).await;
        client.until("webots:").await;
        (begin.elapsed(), client)
    });
    let all = futures_util::future::join_all(clients).await;
    all.iter().map(|(time, _)| *time).sum::<Duration>() / 4
}

#[actix_rt::test]
async fn on_a_quiet_machine_a_class_of_another_world_starts_as_if_none_were_ready() {
    let (with, without) = (start_of_another_world(4).await, start_of_another_world(0).await);
    println!("all slots taken by ready ones: {with:.2?}, none: {without:.2?}");
    assert!(with <= without.mul_f64(1.2), "{with:?}, without {without:?}");
}

/// The processor time of a server and its simulations in ten seconds, in seconds.
async fn cost(server: &Server) -> f64 {
    let used = || {
        let of_simulations = instances_below(&server.cache()).into_iter().map(|(pid, _)| pid);
        let ticks = of_simulations.chain([server.pid()]).filter_map(|pid| {
            let stat = procfs::process::Process::new(pid).ok()?.stat().ok()?;
            Some(stat.utime + stat.stime)
        });
        ticks.sum::<u64>()
    };
    let before = used();
    actix_rt::time::sleep(Duration::from_secs(10)).await;
    #[expect(clippy::cast_precision_loss, reason = "a few ticks")]
    let ticks = (used() - before) as f64;
    ticks / procfs::ticks_per_second() as f64
}

#[actix_rt::test]
async fn on_a_quiet_machine_those_that_are_ready_cost_what_idle_simulations_cost() {
    const COUNT: u16 = 30;
    let server = keeping(demo_server(COUNT), COUNT.into()).start().await;
    let begin = Instant::now();
    while kept(&server).await["ready"] != COUNT {
        assert!(begin.elapsed() < Duration::from_mins(2), "{}", kept(&server).await);
        actix_rt::time::sleep(Duration::from_millis(200)).await;
    }
    let ready = cost(&server).await;
    let mut clients = Vec::new();
    for _ in 0..COUNT {
        clients.push(Client::ready(&server).await);
    }
    let idle = cost(&server).await;
    println!(
        "{COUNT} that are ready: {ready:.2} s of processor time in 10 s, idle simulations of clients: {idle:.2} s"
    );
    assert!(ready <= 1.2 * idle + 0.1, "{ready}, idle {idle}");
}

#[actix_rt::test]
async fn an_upgrade_starts_anew_what_is_ready_and_keeps_what_a_client_has() {
    let server = keeping(demo_server(3), 2).start().await;
    until_ready(&server, 2).await;
    let (client, _) = Client::resumable(&server).await;
    until_ready(&server, 2).await;
    let before = pids(&server);
    let of_three = before.len();
    let (succeeds, told) = server.upgrade().await;
    assert!(succeeds, "{told}");
    until("those of the older process have ended", async || {
        pids(&server).iter().filter(|pid| before.contains(pid)).count() == of_three / 3
    })
    .await;
    until_ready(&server, 2).await;
    assert_eq!(pids(&server).len(), of_three, "nothing is started twice");
    assert_eq!(server.simulations().await[0]["id"], client.id());
    client.close_with(1000).await;
    until("one process is left", async || server.processes().len() == 1).await;
    until("it is listed no more", async || server.simulations().await.is_empty()).await;
    until_ready(&server, 2).await;
}
