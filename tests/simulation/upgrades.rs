//! Upgrades: the program is started anew while clients come and go, and nobody notices.

use std::cell::{Cell, RefCell};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::time::Duration;

use futures_util::future::join_all;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;

use super::life::quick;
use crate::support::http::{self, PASSWORD, get_as_administrator, post};
use crate::support::wrapper::Wrapper;
use crate::support::{Builder, Client, SOON, Server, arm, demo_server, instances_below, until};

/// What goes on while a server is upgraded.
#[derive(Default)]
struct Traffic {
    /// Number of upgrades so far.
    upgrades: Cell<u32>,
    is_over: Cell<bool>,
    /// Number of simulations whose clients were served to the end.
    served: Cell<u32>,
    failures: RefCell<Vec<String>>,
}

impl Traffic {
    /// Requests `/load` every 10 ms, each time on a new connection.
    async fn poll(&self, server: &Server) {
        while !self.is_over.get() {
            match http::try_get(&server.url("/load")).await {
                Ok(answer) => self.check_load(answer.status.as_u16(), &answer.text()),
                Err(error) => self.failures.borrow_mut().push(error),
            }
            actix_rt::time::sleep(Duration::from_millis(10)).await;
        }
    }

    /// Requests `/status` as often, always on the same connection: it never says that the server drains.
    async fn poll_on_one_connection(&self, server: &Server) {
        let mut socket = BufReader::new(TcpStream::connect(server.address()).await.unwrap());
        while !self.is_over.get() {
            let request = b"GET /status HTTP/1.1\r\nHost: x\r\n\r\n";
            socket.write_all(request).await.unwrap();
            let answer = actix_rt::time::timeout(SOON, answer(&mut socket)).await.unwrap();
            if !answer.contains("\"draining\":false") {
                self.failures.borrow_mut().push(answer);
            }
            actix_rt::time::sleep(Duration::from_millis(10)).await;
        }
    }

    fn check_load(&self, status: u16, load: &str) {
        if status != 200 || load.parse::<f64>().is_err() {
            self.failures.borrow_mut().push(format!("{status} {load}"));
        }
    }

    /// Starts simulations, one after the other, each of which runs over at least one upgrade.
    async fn visit(&self, server: &Server, is_resumable: bool) {
        while !self.is_over.get() {
            let begun = self.upgrades.get();
            let (mut client, token) = if is_resumable {
                let (client, token) = Client::resumable(server).await;
                (client, Some(token))
            } else {
                (Client::ready(server).await, None)
            };
            let mut viewer = viewer(server, &client).await.with_running_scene().await;
            let mut last = viewer.time().await;
            while self.upgrades.get() == begun && !self.is_over.get() {
                let now = viewer.time().await;
                assert!(now >= last, "it began anew: {last} {now}");
                last = now;
            }
            if let Some(token) = token {
                drop((client, viewer));
                client = Client::resuming(server, &token).await;
                client.until("webots:").await;
                viewer = self::viewer(server, &client).await;
                viewer.send("w3d;broadcast").await;
                let now = viewer.time().await;
                assert!(now >= last, "it began anew: {last} {now}");
            }
            drop(viewer);
            client.close_with(1000).await;
            self.served.set(self.served.get() + 1);
        }
    }
}

/// The body of an answer.
async fn answer(socket: &mut BufReader<TcpStream>) -> String {
    let mut length = 0;
    loop {
        let mut line = String::new();
        assert!(
            socket.read_line(&mut line).await.unwrap() > 0,
            "the connection is closed"
        );
        if let Some(told) = line.to_lowercase().strip_prefix("content-length: ") {
            length = told.trim().parse().unwrap();
        }
        if line == "\r\n" {
            break;
        }
    }
    let mut body = vec![0; length];
    socket.read_exact(&mut body).await.unwrap();
    String::from_utf8(body).unwrap()
}

/// A viewer of a client's simulation.
async fn viewer(server: &Server, client: &Client) -> Client {
    let told = client
        .heard
        .iter()
        .rev()
        .find_map(|text| text.strip_prefix("webots:"))
        .unwrap();
    assert!(told.starts_with("ws://localhost:"), "{told} {}", server.port);
    Client::connect(&told.replace("localhost", "127.0.0.1")).await
}

/// Upgrades a server, which must succeed. Returns the process that has the port now.
async fn upgrade(server: &Server) -> i32 {
    let (succeeds, told) = server.upgrade().await;
    assert!(succeeds, "{told}");
    told.split(' ')
        .nth(1)
        .and_then(|pid| pid.parse().ok())
        .unwrap_or_else(|| panic!("{told}"))
}

/// Why an upgrade fails.
async fn failed_upgrade(server: &Server) -> String {
    let (succeeds, told) = server.upgrade().await;
    assert!(!succeeds, "{told}");
    told
}

/// Ends a server whose main process this is, and checks that nothing is left of it.
async fn ends_clean(server: &Server, main: i32) {
    kill(Pid::from_raw(main), Signal::SIGTERM).unwrap();
    until("all processes have ended", async || server.processes().is_empty()).await;
    until("nothing is left", async || {
        let runs = std::fs::read_dir(server.cache().join("runs")).unwrap();
        runs.count() == 0 && instances_below(&server.cache()).is_empty()
    })
    .await;
    // A process that ends loses its command line before its open files.
    until("nobody listens", async || {
        TcpStream::connect(server.address()).await.is_err()
    })
    .await;
}

/// Upgrades a server so often, under so many clients.
async fn under_clients(streaming: &str, clients: u16, upgrades: u32) {
    let server = quick(demo_server(clients + 4))
        .set("streaming", streaming)
        .start()
        .await;
    let traffic = Traffic::default();
    let visits = (0..clients).map(|number| traffic.visit(&server, number % 2 == 0));
    let upgrading = async {
        let mut main = server.pid();
        for number in 1..=upgrades {
            let before = traffic.served.get();
            main = upgrade(&server).await;
            traffic.upgrades.set(number);
            until("clients come and go", async || {
                traffic.served.get() >= before + u32::from(clients) / 2 || !traffic.failures.borrow().is_empty()
            })
            .await;
        }
        traffic.is_over.set(true);
        main
    };
    let polls = async { tokio::join!(traffic.poll(&server), traffic.poll_on_one_connection(&server)) };
    let (main, ..) = tokio::join!(upgrading, join_all(visits), polls);
    assert_eq!(*traffic.failures.borrow(), Vec::<String>::new());
    until("only one process is left", async || server.processes() == [main]).await;
    let csv = std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap();
    for line in csv.lines().skip(1) {
        assert_eq!(line.split(',').nth(10), Some("left"), "{line}");
    }
    ends_clean(&server, main).await;
}

#[actix_rt::test]
async fn clients_that_come_and_go_notice_no_upgrade() {
    for streaming in ["relay", "direct"] {
        under_clients(streaming, 4, 3).await;
    }
}

#[actix_rt::test]
async fn on_a_quiet_machine_thirty_clients_notice_none_of_twenty_upgrades() {
    under_clients("relay", 30, 20).await;
}

fn with_password(places: u16) -> Builder {
    quick(demo_server(places))
        .set("adminPassword", PASSWORD)
        .set("streaming", "relay")
}

#[actix_rt::test]
async fn what_is_for_an_older_process_reaches_it_through_the_newest() {
    let server = with_password(4).start().await;
    let mut clients = Vec::new();
    let mut mains = vec![server.pid()];
    for _ in 0..3 {
        clients.push(Client::resumable(&server).await);
        mains.push(upgrade(&server).await);
    }
    let main = mains[3];
    assert_eq!(server.processes().len(), 4);
    let status = get_as_administrator(&server.url("/status")).await.json();
    let simulations = status["simulations"].as_array().unwrap();
    let mut listed: Vec<&str> = simulations.iter().map(|one| one["id"].as_str().unwrap()).collect();
    listed.sort_unstable();
    assert_eq!(
        listed,
        clients.iter().map(|(client, _)| client.id()).collect::<Vec<_>>()
    );
    assert_eq!(status["instances"]["places"], 4);
    assert_eq!(
        status["instances"]["idle"].as_u64().unwrap() + status["instances"]["running"].as_u64().unwrap(),
        3
    );
    for (client, _) in &clients {
        let id = client.id();
        let page = get_as_administrator(&server.url(&format!("/watch?id={id}"))).await;
        let page = page.text();
        let path = page.split("stream/").nth(1).unwrap_or_else(|| panic!("{page}"));
        let token: String = path.chars().take_while(char::is_ascii_hexdigit).collect();
        let stream = server.websocket(&format!("/stream/{token}"));
        let mut viewer = Client::connect(&stream).await;
        viewer.send("w3d;broadcast").await;
        viewer.until("scene load completed").await;
        let output = get_as_administrator(&server.url(&format!("/output?id={id}"))).await;
        assert_eq!(output.status, 200);
        let page = http::get_with_password(&server.url("/monitor"), PASSWORD).await.text();
        assert!(page.contains(id), "{page}");
    }
    // A used token, an unknown one, and one of a process that has ended are answered as always.
    for token in ["0".repeat(48), "f".repeat(48)] {
        assert_eq!(
            http::get(&server.url(&format!("/stream/{token}/a.png"))).await.status,
            404
        );
        let mut client = Client::resuming(&server, &token).await;
        assert_eq!(
            client.until("loading: ").await,
            "loading: Error: this simulation has ended"
        );
    }
    let id = clients[1].0.id().to_owned();
    let stop = server.url(&format!("/simulations/{id}/stop"));
    assert_eq!(
        post(&stop, Some(PASSWORD), r#"{"reason": "the lesson is over"}"#).await,
        202
    );
    let told = clients[1].0.until("loading: Error").await;
    assert!(told.ends_with("the lesson is over"), "{told}");
    until("its process has ended", async || server.processes().len() == 3).await;
    until("it is not listed", async || server.simulations().await.len() == 2).await;
    assert_eq!(post(&stop, Some(PASSWORD), "").await, 404);
    // What a process is to stop is not reported as stopped while it hangs.
    let hanging = Pid::from_raw(mains[2]);
    let last = server.url(&format!("/simulations/{}/stop", clients[2].0.id()));
    kill(hanging, Signal::SIGSTOP).unwrap();
    assert_eq!(post(&last, Some(PASSWORD), "").await, 404);
    kill(hanging, Signal::SIGCONT).unwrap();
    // A stop of the newest ends them all.
    ends_clean(&server, main).await;
    assert_eq!(clients[0].0.closed().await, Some(1001));
}

#[actix_rt::test]
async fn who_waits_at_an_older_process_gets_its_slots_first() {
    let server = quick(demo_server(1)).start().await;
    let first = Client::ready(&server).await;
    let mut second = Client::start(&server, &arm()).await;
    second.until("queue: 0").await;
    let main = upgrade(&server).await;
    let mut third = Client::start(&server, &arm()).await;
    third.until("queue: 0").await;
    first.close_with(1000).await;
    second.until("webots:").await;
    assert!(
        third.is_silent(Duration::from_millis(500)).await || third.heard.iter().all(|text| !text.contains("webots"))
    );
    second.close_with(1000).await;
    third.until("webots:").await;
    until("the older process has ended", async || server.processes() == [main]).await;
    drop(third);
    ends_clean(&server, main).await;
}

/// Makes this program one that does this, with the arguments in `$@`.
fn replace(program: &Path, script: &str) {
    let new = program.with_extension("new");
    std::fs::write(&new, format!("#!/bin/sh\n{script}\n")).unwrap();
    std::fs::set_permissions(&new, std::fs::Permissions::from_mode(0o755)).unwrap();
    std::fs::rename(new, program).unwrap();
}

/// Waits until nothing is left of processes that could not take over; they tell why before they end.
async fn only_the_first_is_left(server: &Server) {
    until("only the first process is left", async || {
        let runs = std::fs::read_dir(server.cache().join("runs")).unwrap();
        server.processes() == [server.pid()] && runs.count() == 1
    })
    .await;
}

#[actix_rt::test]
async fn an_upgrade_that_fails_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("simulation-server");
    let real = Path::new(env!("CARGO_BIN_EXE_simulation-server"));
    symlink(real, &program).unwrap();
    let begin = format!("exec {} \"$@\"", program.display());
    let server = quick(demo_server(3)).before(&begin).start().await;
    let (client, token) = Client::resumable(&server).await;
    let real = real.display();
    let is_check = "case \"$*\" in *--check*) exit 0;; esac";
    for (script, why) in [
        ("exit 3".to_owned(), "--check fails"),
        (format!("{is_check}\nexit 1"), "has ended before it was ready"),
        // One that knows nothing of upgrades.
        (
            format!("{is_check}\nexec {real} --no-such-option"),
            "has ended before it was ready",
        ),
        (
            // One of another version takes nothing over.
            format!(
                "{is_check}\nhead --lines=1 >{0}/passed; echo '{{\"failed\":\"another version\"}}' >&0; exit 1",
                folder.path().display()
            ),
            "another version",
        ),
    ] {
        replace(&program, &script);
        let told = failed_upgrade(&server).await;
        assert!(told.contains(why), "{script}: {told}");
        assert!(server.log().contains("no other process takes over"), "{}", server.log());
        only_the_first_is_left(&server).await;
        Client::ready(&server).await.close_with(1000).await;
    }
    std::fs::remove_file(&program).unwrap();
    assert!(failed_upgrade(&server).await.contains("can't be started"));
    symlink(real.to_string(), &program).unwrap();
    let file = server.folder.join("config.json");
    let before = std::fs::read_to_string(&file).unwrap();
    for (key, value, why) in [
        ("waitingLine", serde_json::json!("long"), "waitingLine"),
        (
            "port",
            serde_json::json!(server.port + 40),
            "which needs a stop and a start",
        ),
        ("webots", serde_json::json!("/nonexistent"), "/nonexistent"),
    ] {
        server.rewrite_config(|config| config[key] = value);
        let told = failed_upgrade(&server).await;
        assert!(told.contains(why), "{told}");
        std::fs::write(&file, &before).unwrap();
        only_the_first_is_left(&server).await;
    }
    drop(client);
    let mut client = Client::resuming(&server, &token).await;
    client.until("webots:").await;
    let main = upgrade(&server).await;
    client.close_with(1000).await;
    until("the older process has ended", async || server.processes() == [main]).await;
    ends_clean(&server, main).await;
}

#[actix_rt::test]
async fn older_processes_outlive_a_crash_of_the_newest() {
    let folder = tempfile::tempdir().unwrap();
    let builder = || quick(demo_server(3)).set("streaming", "relay").folder(folder.path());
    let server = builder().start().await;
    let (client, token) = Client::resumable(&server).await;
    let mut viewer = viewer(&server, &client).await.with_running_scene().await;
    let main = upgrade(&server).await;
    let (lost, _) = Client::resumable(&server).await;
    kill(Pid::from_raw(main), Signal::SIGKILL).unwrap();
    until("it has ended", async || server.processes() == [server.pid()]).await;
    viewer.time().await;
    // Whoever starts it again gets the socket.
    let again = builder().port(server.port).start().await;
    viewer.time().await;
    drop((client, viewer, lost));
    let mut client = Client::resuming(&again, &token).await;
    client.until("webots:").await;
    let other = Client::ready(&again).await;
    assert_eq!(again.simulations().await.len(), 2);
    other.close_with(1000).await;
    ends_clean(&again, again.pid()).await;
    assert_eq!(client.closed().await, Some(1001));
}

#[actix_rt::test]
async fn a_checkout_goes_on_and_a_new_process_waits_for_its_fetch() {
    let folder = tempfile::tempdir().unwrap();
    let held = folder.path().join("held");
    std::fs::write(&held, "").unwrap();
    let wrapper = Wrapper::git(&format!(
        "case \"$*\" in *fetch*) while [ -e {} ]; do sleep 0.05; done;; esac",
        held.display()
    ));
    let server = quick(demo_server(3)).env("PATH", &wrapper.path()).start().await;
    let mut first = Client::start(&server, &arm()).await;
    until("it fetches", async || wrapper.count("fetch") == 1).await;
    let main = upgrade(&server).await;
    let mut second = Client::start(&server, &arm()).await;
    second
        .until("loading: Step 2/9 : fetching https://github.com/lab/arm: waiting for another fetch")
        .await;
    assert!(second.is_silent(Duration::from_millis(500)).await, "{:?}", second.heard);
    assert_eq!(wrapper.count("fetch"), 1, "one at a time: {:?}", wrapper.calls());
    std::fs::remove_file(held).unwrap();
    first.until("webots:").await;
    second.until("webots:").await;
    first.close_with(1000).await;
    until("the older process has ended", async || server.processes() == [main]).await;
    second.close_with(1000).await;
    ends_clean(&server, main).await;
}

#[actix_rt::test]
async fn on_a_quiet_machine_a_drain_during_an_upgrade_is_not_lost() {
    let server = quick(demo_server(2)).start().await;
    let client = Client::ready(&server).await;
    let serving = server.cache().join("serving");
    let before = std::fs::read_link(&serving).unwrap();
    let draining = async {
        // For a moment both have the port.
        until("another process is ready", async || {
            std::fs::read_link(&serving).unwrap() != before
        })
        .await;
        kill(Pid::from_raw(server.pid()), Signal::SIGUSR1).unwrap();
    };
    let (told, ()) = tokio::join!(failed_upgrade(&server), draining);
    assert!(told.contains("it drains"), "{told}");
    only_the_first_is_left(&server).await;
    assert_eq!(server.status().await["draining"], true);
    client.close_with(1000).await;
    until("it has ended", async || server.processes().is_empty()).await;
}
