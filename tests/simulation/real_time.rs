//! How fast simulations run: it is shown, told and recorded, and a server whose simulations are slow offers fewer places.

use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};

use crate::support::{
    Builder, Client, SOON, Server, WORLD, arm, demo_server, http, instances_below, session_server, until,
};

/// A server whose simulations have a relayed stream and need this much processor time for each second.
fn server(places: u16, work: &str) -> Builder {
    let builder = demo_server(places).set("streaming", "relay").set("isolation", "none");
    let (first, rest) = WORLD.split_once('\n').unwrap();
    let world = format!("{first}\n#demo-simulator: work={work}\n{rest}");
    builder.forge().commit("lab/arm", "main", &[("worlds/a.wbt", &world)]);
    builder
}

/// A client, and a page that shows its running simulation.
struct Seat {
    client: Client,
    page: tokio::task::JoinHandle<()>,
    /// For the page, to steer the simulation.
    commands: tokio::sync::mpsc::UnboundedSender<&'static str>,
}

impl Seat {
    async fn take(server: &Server) -> Self {
        let mut client = Client::start(server, &arm()).await;
        let url = client.until("webots:").await;
        let path = url.split_once("/stream/").unwrap().1;
        let mut viewer = Client::connect(&server.websocket(&format!("/stream/{path}")))
            .await
            .with_running_scene()
            .await;
        let (commands, mut told) = tokio::sync::mpsc::unbounded_channel();
        let page = actix_rt::spawn(async move {
            loop {
                tokio::select! {
                    command = told.recv() => match command {
                        Some(command) => viewer.send(command).await,
                        None => return,
                    },
                    _ = viewer.next_within(Duration::from_hours(1)) => viewer.heard.clear(),
                }
            }
        });
        Self { client, page, commands }
    }

    fn say(&self, command: &'static str) {
        self.commands.send(command).unwrap();
    }

    async fn leave(self) {
        self.page.abort();
        self.client.leave().await;
    }
}

/// The factor of each simulation, as `/status` has it.
async fn factors(server: &Server) -> Vec<Option<f64>> {
    let all = server.simulations().await;
    all.iter().map(|one| one["realTime"].as_f64()).collect()
}

/// Waits until this many simulations run in real time.
async fn until_well(server: &Server, count: usize) {
    until("all run in real time", async || {
        let factors = factors(server).await;
        factors.len() == count && factors.iter().all(|factor| factor.is_some_and(|factor| factor > 0.97))
    })
    .await;
}

/// The line of the first simulation in `simulations.csv`, once it is there.
async fn recorded(server: &Server) -> Vec<String> {
    let read = || std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap_or_default();
    until("its end is recorded", async || read().lines().count() > 1).await;
    read().lines().nth(1).unwrap().split(',').map(str::to_owned).collect()
}

#[actix_rt::test]
async fn a_simulation_that_is_slow_is_shown_told_counted_and_recorded() {
    // It needs two processors, and uses one.
    let server = server(1, "2").start().await;
    let mut seat = Seat::take(&server).await;
    let told = seat.client.within("realTime: ", SOON).await;
    let share: f64 = told["realTime: ".len()..].parse().unwrap();
    assert!((0.0..=0.5).contains(&share), "{told}");
    let factor = factors(&server).await[0].unwrap();
    assert!(factor > 0.0 && factor < 0.6, "{factor}");
    let monitor = server.monitor().await;
    assert!(monitor.contains("data-label=\"Real time\""), "{monitor}");
    let metrics = server.metrics().await;
    let slow = "webots_simulation_real_time_factor_bucket{le=\"0.75\"} ";
    let count = metrics.split(slow).nth(1).unwrap().lines().next().unwrap();
    assert!(count.parse::<u32>().unwrap() >= 1, "{metrics}");
    // One alone says nothing about the machine.
    assert_eq!(
        server.status().await["realTime"],
        json!({"target": 0.9, "places": null})
    );
    // While it is paused, it is not slow.
    seat.say("pause");
    seat.client.within("realTime: 1", SOON).await;
    assert_eq!(factors(&server).await, [None]);
    seat.leave().await;
    let line = recorded(&server).await;
    let [.., mean, slow] = &line[..] else {
        panic!("{line:?}")
    };
    assert!((1..=60).contains(&mean.parse::<u32>().unwrap()), "{line:?}");
    assert!(slow.parse::<u32>().unwrap() > 90, "{line:?}");
}

#[actix_rt::test]
async fn pauses_do_not_count() {
    let server = server(1, "0").start().await;
    let seat = Seat::take(&server).await;
    for _ in 0..4 {
        actix_rt::time::sleep(Duration::from_millis(2500)).await;
        seat.say("pause");
        actix_rt::time::sleep(Duration::from_millis(2500)).await;
        seat.say("real-time:-1");
    }
    seat.leave().await;
    let line = recorded(&server).await;
    let [.., mean, slow] = &line[..] else {
        panic!("{line:?}")
    };
    assert!((95..=105).contains(&mean.parse::<u32>().unwrap()), "{line:?}");
    assert_eq!(slow, "0", "{line:?}");
}

/// Stops the processes of some simulations for most of the time.
struct Brake {
    pids: Vec<i32>,
    task: tokio::task::JoinHandle<()>,
}

impl Brake {
    /// On the simulations in the first slots: clients have these, and what is kept ready has a later one.
    fn on(server: &Server, simulations: u16) -> Self {
        let ports: Vec<String> = (1..=simulations)
            .map(|slot| format!("--port={}", server.port + slot))
            .collect();
        let is_theirs = |words: &str| {
            let mut options = words.split_whitespace();
            words.starts_with(env!("CARGO_BIN_EXE_demo-simulator"))
                && options.any(|option| ports.iter().any(|port| port == option))
        };
        let all = instances_below(&server.cache()).into_iter();
        let pids: Vec<i32> = all.filter(|(_, words)| is_theirs(words)).map(|(pid, _)| pid).collect();
        assert_eq!(pids.len(), ports.len());
        let stopped = pids.clone();
        let task = actix_rt::spawn(async move {
            loop {
                for (signal, time) in [(Signal::SIGSTOP, 1500), (Signal::SIGCONT, 300)] {
                    for pid in &stopped {
                        kill(Pid::from_raw(*pid), signal).ok();
                    }
                    actix_rt::time::sleep(Duration::from_millis(time)).await;
                }
            }
        });
        Self { pids, task }
    }
}

impl Drop for Brake {
    fn drop(&mut self) {
        self.task.abort();
        for pid in &self.pids {
            kill(Pid::from_raw(*pid), Signal::SIGCONT).ok();
        }
    }
}

async fn places(server: &Server) -> Value {
    server.status().await["realTime"]["places"].clone()
}

#[actix_rt::test]
async fn a_server_whose_simulations_are_slow_offers_fewer_places_until_they_are_well() {
    let ready = |count: u32| json!([{"world": arm(), "count": count}]);
    let builder = server(6, "0.001").set("readyLoad", 1000).set("ready", ready(1));
    let server = builder.start().await;
    let session = session_server(&[server.address()])
        .set("loadThreshold", 1000)
        .start()
        .await;
    let mut seats = Vec::new();
    for _ in 0..4 {
        seats.push(Seat::take(&server).await);
    }
    let kept = async || server.status().await["ready"][0].clone();
    until("one is ready", async || kept().await["ready"] == 1).await;
    until_well(&server, 4).await;
    let brake = Brake::on(&server, 1);
    until("one is slow", async || {
        factors(&server).await.iter().flatten().any(|factor| *factor < 0.8)
    })
    .await;
    actix_rt::time::sleep(Duration::from_secs(3)).await;
    assert_eq!(places(&server).await, Value::Null, "one says nothing about the machine");
    drop(brake);
    until_well(&server, 4).await;
    let brake = Brake::on(&server, 4);
    until("places are withheld", async || places(&server).await == 2).await;
    let status = server.status().await;
    assert_eq!(status["instances"]["places"], 2, "{status}");
    let load = http::get(&server.url("/load")).await.text();
    assert!(load.parse::<f64>().unwrap() >= 99.0, "{load}");
    assert!(server.metrics().await.contains("webots_simulation_places_withheld 4"));
    assert!(server.monitor().await.contains("2 of 6 places are offered"));
    until("the session server sends nobody", async || {
        let answer = http::get(&session.url(&format!("/session?url={}", arm()))).await.text();
        answer.contains("no simulation server available")
    })
    .await;
    // None is started to be kept ready.
    let is_kept = async || {
        let now = kept().await;
        assert_eq!((&now["ready"], &now["starting"]), (&json!(1), &json!(0)), "{now}");
    };
    server.reload(json!({ "ready": ready(2) }));
    until("two are wanted", async || kept().await["wanted"] == 2).await;
    actix_rt::time::sleep(Duration::from_secs(3)).await;
    is_kept().await;
    // Who comes anyway waits, though one is ready, which stays.
    let mut next = Client::start(&server, &arm()).await;
    assert_eq!(next.within("queue: ", SOON).await, "queue: 0");
    actix_rt::time::sleep(Duration::from_secs(1)).await;
    is_kept().await;
    drop(brake);
    until("those that are there have shown that they fit", async || {
        places(&server).await == 4
    })
    .await;
    assert!(next.heard.iter().all(|text| !text.starts_with("webots:")));
    seats.pop().unwrap().leave().await;
    next.within("webots:", SOON).await;
}

#[actix_rt::test]
async fn without_a_target_all_places_are_offered() {
    let server = server(3, "0.001").set("realTime.target", 0).start().await;
    let _seats = [Seat::take(&server).await, Seat::take(&server).await];
    until_well(&server, 2).await;
    let _brake = Brake::on(&server, 2);
    until("both are slow", async || {
        factors(&server)
            .await
            .iter()
            .flatten()
            .filter(|factor| **factor < 0.8)
            .count()
            == 2
    })
    .await;
    actix_rt::time::sleep(Duration::from_secs(3)).await;
    Client::ready(&server).await;
    assert_eq!(server.status().await["instances"]["places"], 3);
}
