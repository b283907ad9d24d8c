//! Leaving a simulation in every state and for every reason: nothing of it remains.
//!
//! The states are those of [`ALL`]: connected, queued, checking out, launching, idle, running, stopping.
//!
//! | reason | in which states | tested by |
//! |---|---|---|
//! | its client closes, the connection breaks or is half open | all but stopping, in which it has no client | `a_client_that_leaves_in_any_way_leaves_nothing_behind` |
//! | Webots ends, in three ways | launching, idle, running; in others there is no Webots | `a_client_is_told_how_webots_ended` |
//! | Webots ignores SIGTERM | stopping | `isolation::lives::a_simulation_that_ignores_sigterm_is_killed` |
//! | git is killed, or hangs | checking out | `checkout::a_kill_in_the_middle_of_a_fetch...`, `slow_git::a_git_that_is_stopped...` |
//! | the time limit | launching, idle, running, stopping: it counts from the start of Webots | `simulation_limits` (`time`) |
//! | the limits of a checkout and of a launch | checking out, launching | `simulation_limits` (`time`), `ready::a_launch_that_never_listens...` |
//! | SIGTERM to the server | all | `a_server_that_stops_notifies_clients_and_leaves_nothing` |
//! | SIGKILL to the server | all | `a_server_that_is_killed_leaves_nothing_in_any_state` |
//! | the client's actor panics | all but stopping, in which it has ended | `simulation_limits` (`panics`) |

use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::scene::{ALL, Scene, gone_within, instance_folders, nothing_left, stages};
use crate::support::{Builder, Client, DEMO, Webots, arm, demo_server, instances_below, server_of, until};

/// The grace time of most tests here, in seconds.
const GRACE: f64 = 0.3;

pub fn quick(builder: Builder) -> Builder {
    builder.set("timing.grace", GRACE).set("timing.heartbeat", 0.2)
}

#[actix_rt::test]
async fn a_client_that_leaves_in_any_way_leaves_nothing_behind() {
    // All but the last, in which there is no client.
    for state in &ALL[..6] {
        for way in ["closes", "breaks", "is half open"] {
            // An unpolled client answers no pings, but its connection stays open.
            let silence = if way == "is half open" { 4.0 } else { 60.0 };
            let change = |builder| quick(builder).set("timing.ping", 0.1).set("timing.silence", silence);
            let mut scene = Scene::new(state, change).await;
            let mut left = Instant::now();
            match way {
                "closes" => {
                    scene.client.take().unwrap().leave().await;
                    if let Some(other) = scene.other.take() {
                        until("the line is empty", async || stages(&scene.server).await == ["idle"]).await;
                        left = Instant::now();
                        other.leave().await;
                    }
                }
                // Dropped without a close frame.
                "breaks" => drop((scene.client.take(), scene.other.take())),
                _ if *state == "connected" => {
                    until("it is sent away", async || {
                        scene.server.log().contains("silent for too long")
                    })
                    .await;
                }
                _ => {}
            }
            if way == "is half open" {
                nothing_left(&scene.server, 1).await;
            } else {
                gone_within(GRACE, left, &scene.server).await;
            }
            assert!(
                !scene.server.log().contains("Wrong message"),
                "every closed laptop does that"
            );
        }
    }
}

#[actix_rt::test]
async fn a_server_that_stops_notifies_clients_and_leaves_nothing() {
    for state in ALL {
        let mut scene = Scene::new(state, |builder| quick(builder).set("timing.grace", 2.0)).await;
        let asked = Instant::now();
        scene.server.signal(Signal::SIGTERM);
        if state == "stopping" {
            until("it stops", async || scene.server.log().contains("stopping")).await;
            // It accepts no new clients.
            scene.client = Some(Client::start(&scene.server, &arm()).await);
        }
        for client in [&mut scene.client, &mut scene.other].into_iter().flatten() {
            assert_eq!(
                client.until("loading: Error:").await,
                "loading: Error: This simulation server is stopping"
            );
            assert_eq!(client.closed().await, Some(1001), "{state:?}");
        }
        assert_eq!(scene.server.ended().await, Some(0), "{state:?}");
        assert!(asked.elapsed() < Duration::from_secs(10), "{state:?}");
        assert_eq!(instances_below(scene.folder.path()), [], "{state:?}");
        let runs = std::fs::read_dir(scene.folder.path().join("cache/runs"))
            .unwrap()
            .count();
        assert_eq!(runs, 0, "{state:?}: the folder of the run is left");
    }
}

#[actix_rt::test]
async fn a_server_that_is_killed_leaves_nothing_in_any_state() {
    for state in ALL {
        // The grace time is long enough to see the simulation stopping.
        let mut scene = Scene::new(state, |builder| quick(builder).set("timing.grace", 2.0)).await;
        scene.server.signal(Signal::SIGKILL);
        scene.server.ended().await;
        until("all processes are gone", async || {
            instances_below(scene.folder.path()).is_empty()
        })
        .await;
        let runs = scene.folder.path().join("cache/runs");
        until("its folder is gone", async || {
            std::fs::read_dir(&runs).unwrap().count() == 0
        })
        .await;
    }
}

#[actix_rt::test]
async fn what_a_killed_server_has_left_is_removed_at_the_next_start() {
    let mut scene = Scene::new("checkingout", quick).await;
    // The guardian, which would clean up, is killed too.
    kill(Pid::from_raw(scene.server.guardian()), Signal::SIGKILL).unwrap();
    scene.server.signal(Signal::SIGKILL);
    scene.server.ended().await;
    assert_eq!(instance_folders(scene.folder.path()).len(), 1);
    // The server recognizes processes of simulations by this mark.
    let mark = instance_folders(scene.folder.path()).remove(0).canonicalize().unwrap();
    let mut orphan = std::process::Command::new("sleep")
        .arg("1000")
        .env("WEBOTS_FLEET_INSTANCE", mark)
        .spawn()
        .unwrap();
    let next = demo_server(1).folder(scene.folder.path()).start().await;
    assert!(!orphan.wait().unwrap().success(), "it was killed");
    assert_eq!(instance_folders(scene.folder.path()).len(), 0);
    assert!(
        next.log().contains("removed what 1 earlier runs had left"),
        "{}",
        next.log()
    );
    until("git is gone", async || instances_below(scene.folder.path()).is_empty()).await;
}

#[actix_rt::test]
async fn a_guardian_that_was_stopped_is_continued_and_ends_with_the_server() {
    let mut server = demo_server(1).set("isolation", "none").start().await;
    let pid = server.guardian();
    let state = move || {
        procfs::process::Process::new(pid)
            .and_then(|one| one.stat())
            .map(|stat| stat.state)
    };
    let stop = move || kill(Pid::from_raw(pid), Signal::SIGSTOP).unwrap();
    stop();
    until("it is continued", async || {
        server.log().contains("a program has stopped the guardian") && state().is_ok_and(|now| now == 'S')
    })
    .await;
    stop();
    server.stops().await;
    until("it has ended", async || !state().is_ok_and(|now| now != 'Z')).await;
}

#[actix_rt::test]
async fn a_client_is_told_how_webots_ended() {
    let table = [
        ("exit 0", "loading: Webots has ended"),
        (
            "echo 'no licence' >&2; exit 3",
            "loading: Error: Webots ended with exit code 3",
        ),
        (
            "kill -SEGV $$",
            "loading: Error: Webots was ended by the signal SIGSEGV",
        ),
    ];
    for (end, words) in table {
        // It ends while it launches, after it has become ready, or while it runs.
        let ready = |pace: &str| format!("{DEMO} \"$@\" &\nsleep 0.5; echo {pace}");
        for start in [String::new(), ready("pause"), ready("real-time")] {
            let webots = Webots::script(&format!("{start}\n{end}"));
            let server = quick(server_of(webots, 1)).start().await;
            let mut client = Client::start(&server, &arm()).await;
            client.until("shutdownTimeout").await;
            client.until("loading: ").await;
            if client.heard.last().unwrap() == "loading: webots is starting" {
                client.until("loading: ").await;
            }
            let told = client.heard.last().unwrap().clone();
            // Before its world is ready, an end without an error is a failed start, too.
            let words = match (start.is_empty(), words) {
                (true, "loading: Webots has ended") => "loading: Error: Webots has ended",
                _ => words,
            };
            assert!(told.starts_with(words), "{told}");
            let output = end.contains("licence").then_some("no licence");
            assert_eq!(client.reason()["output"].as_str(), output, "{told}");
            let message = client.reason()["message"].as_str().unwrap().to_owned();
            let sentence = words.trim_start_matches("loading: ").trim_start_matches("Error: ");
            assert!(message.starts_with(sentence), "{message}");
            assert!(!message.contains("licence"), "{message}");
            assert_eq!(
                told.contains(". Its last output: no licence"),
                output.is_some(),
                "{told}"
            );
            // If Webots ends before it listens, the server counts that as its own fault.
            let is_own = start.is_empty() && told.starts_with("loading: Error:");
            assert_eq!(client.closed().await, Some(if is_own { 1013 } else { 1000 }), "{told}");
            nothing_left(&server, 1).await;
        }
    }
}
