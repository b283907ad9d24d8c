//! The class: simulations and who waits, of all servers, at the session server, and actions that it forwards.

use std::collections::BTreeMap;
use std::io::Read;
use std::time::{Duration, Instant};

use flate2::read::MultiGzDecoder;
use futures_util::StreamExt;
use futures_util::future::join_all;
use serde_json::{Value, json};
use webots_fleet::shared::domain::{RosterUpdate, SimulationReport, Stage, ToSessionServer};

use super::stand_in::{Manner, StandIn};
use super::until_states;
use crate::support::http::{PASSWORD, get_as_administrator};
use crate::support::program::{Builder, Server, demo_server, session_server};
use crate::support::reserving::ReservingServer;
use crate::support::{Client, SOON, arm, until};

const KEY: &str = "a key for a whole fleet";
const READER: &str = "fedcba9876543210fedcba9876543210";
const TOKEN: &str = "0123456789abcdef0123456789abcdef";
const TOLD: &str = "loading: Error: The administrator has stopped this simulation";

/// Simulation servers with the key of the fleet, and no password.
fn keyed(places: u16) -> Builder {
    demo_server(places).set("fleetKey", KEY)
}

async fn fleet(servers: &[String]) -> Server {
    let tokens = json!([
        {"name": "backup", "token": TOKEN, "may": "act"},
        {"name": "board", "token": READER, "may": "read"},
    ]);
    let session = session_server(servers)
        .set("loadThreshold", 1000)
        .set("adminPassword", PASSWORD)
        .set("fleetKey", KEY);
    session.set("apiTokens", tokens).start().await
}

async fn start(server: &Server, name: &str) -> Client {
    let mut client = Client::connect(&server.websocket("/client")).await;
    client
        .send(&json!({"start": {"url": arm(), "name": name}}).to_string())
        .await;
    client.until("webots:").await;
    client
}

async fn class(session: &Server) -> Vec<Value> {
    let answer = get_as_administrator(&session.url("/simulations")).await;
    assert_eq!(answer.status, 200, "{}", answer.text());
    answer.json().as_array().unwrap().clone()
}

async fn until_class(session: &Server, count: usize) -> Vec<Value> {
    until(&format!("{count} are in the class"), async || {
        class(session).await.len() == count
    })
    .await;
    class(session).await
}

async fn send(session: &Server, path: &str, token: &str, body: &Value) -> (u16, String) {
    let request = awc::Client::builder().timeout(SOON).finish().post(session.url(path));
    let request = request.insert_header(("Authorization", format!("Bearer {token}")));
    let mut answer = request.send_body(body.to_string()).await.unwrap();
    let text = answer.body().await.unwrap();
    (answer.status().as_u16(), String::from_utf8_lossy(&text).into_owned())
}

#[actix_rt::test]
async fn the_class_is_one_list_and_its_actions_are_forwarded() {
    let servers = [keyed(3).start().await, keyed(3).start().await];
    let session = fleet(&servers.each_ref().map(Server::address)).await;
    until_class(&session, 0).await;
    let mut nora = start(&servers[0], "Nora 14").await;
    let mut noah = start(&servers[0], "Noah").await;
    let mut other = start(&servers[1], "<b>Nora</b>").await;
    let list = until_class(&session, 3).await;
    let one = list.iter().find(|one| one["label"] == "Nora 14").unwrap();
    assert_eq!(one["id"], nora.id());
    assert_eq!(one["server"], servers[0].address());
    assert_eq!(
        (one["world"].as_str(), one["user"].as_str()),
        (Some(arm().as_str()), None)
    );
    until("its state follows", async || {
        class(&session)
            .await
            .iter()
            .all(|one| one["state"] == "idle" || one["state"] == "running")
    })
    .await;

    // One, by its id, with a reason.
    let path = format!("/simulations/{}/stop", nora.id());
    assert_eq!(send(&session, &path, READER, &json!({})).await.0, 403);
    let (status, text) = send(&session, &path, TOKEN, &json!({"reason": "<b>Back"})).await;
    assert_eq!(status, 202, "{text}");
    assert_eq!(
        nora.until("loading: Error:").await,
        format!("{TOLD}: \u{2039}b\u{203a}Back")
    );
    until_class(&session, 2).await;
    assert_eq!(send(&session, &path, TOKEN, &json!({})).await.0, 404);
    until("the log names who has stopped it", async || {
        servers[0].log().contains("token \"backup\" stops it, reason: <b>Back")
    })
    .await;

    // Those that some conditions name.
    let none = json!({"world": arm(), "label": "nobody"});
    let (status, text) = send(&session, "/simulations/stop", TOKEN, &none).await;
    assert_eq!((status, text.as_str()), (202, r#"{"failed":[],"stopped":[]}"#));
    for wrong in [
        json!({}),
        json!({"reason": "x"}),
        json!({"all": true}),
        json!({"ids": "x"}),
    ] {
        assert_eq!(
            send(&session, "/simulations/stop", TOKEN, &wrong).await.0,
            400,
            "{wrong}"
        );
    }
    let (status, text) = send(
        &session,
        "/simulations/stop",
        TOKEN,
        &json!({"server": servers[0].address()}),
    )
    .await;
    assert_eq!((status, text.contains(noah.id())), (202, true), "{text}");
    assert_eq!(noah.until("loading: Error:").await, TOLD);
    other.until(".").await;
    let ids = json!({"ids": [other.id(), "1-1"], "reason": "over"});
    let (status, text) = send(&session, "/simulations/stop", TOKEN, &ids).await;
    assert_eq!(
        (status, text),
        (
            202,
            format!("{{\"failed\":[\"1-1\"],\"stopped\":[\"{}\"]}}", other.id())
        )
    );
    until_class(&session, 0).await;
}

#[actix_rt::test]
async fn a_hundred_stops_in_a_loop_are_not_refused_while_somebody_guesses() {
    const AT_ONCE: u16 = 25;
    let server = keyed(AT_ONCE).start().await;
    let session = fleet(&[server.address()]).await;
    let guess = async |path: &str| {
        let request = awc::Client::builder().timeout(SOON).finish().post(session.url(path));
        let answer = request.basic_auth("student", "guess").send().await.unwrap();
        answer.status().as_u16()
    };
    until_class(&session, 0).await;
    let mut guesses = BTreeMap::<u16, u32>::new();
    let begin = Instant::now();
    for _ in 0..100 / AT_ONCE {
        let clients = join_all((0..AT_ONCE).map(|_| start(&server, "Anna"))).await;
        until_class(&session, AT_ONCE.into()).await;
        for client in &clients {
            let path = format!("/simulations/{}/stop", client.id());
            *guesses.entry(guess(&path).await).or_default() += 1;
            // The password, four times as often: 400 requests, each of which must succeed.
            for _ in 0..4 {
                class(&session).await;
            }
            let (status, text) = send(&session, &path, TOKEN, &json!({})).await;
            assert_eq!(status, 202, "{text}");
            *guesses.entry(guess("/simulations/stop").await).or_default() += 1;
        }
        until_class(&session, 0).await;
    }
    let most = 31.0 + 12.0 * begin.elapsed().as_secs_f64() / 60.0;
    assert!(guesses.keys().eq(&[401, 429]), "{guesses:?}");
    assert!(
        (30.0..=most).contains(&f64::from(guesses[&401])),
        "{guesses:?} of {most}"
    );
}

#[actix_rt::test]
async fn who_waits_is_in_the_class_too() {
    let server = keyed(1).start().await;
    let session = fleet(&[server.address()]).await;
    let _first = start(&server, "Anna").await;
    until_class(&session, 1).await;
    let mut line = Client::connect(&session.websocket("/session")).await;
    let wait = json!({"url": arm(), "wait": true, "name": " Ben\n<script> "});
    line.send(&wait.to_string()).await;
    line.until("ticket:").await;
    let list = until_class(&session, 2).await;
    let ben = list.iter().find(|one| one["state"] == "waiting").unwrap();
    assert_eq!(
        (ben["label"].as_str(), ben["world"].as_str()),
        (Some("Ben <script>"), Some(arm().as_str()))
    );
    assert!(ben.get("server").is_none(), "{ben}");
    line.leave().await;
    until_class(&session, 1).await;
}

#[actix_rt::test]
async fn a_server_that_is_gone_has_no_simulations_in_the_class() {
    let mut server = keyed(2).start().await;
    let session = fleet(&[server.address()]).await;
    let _client = start(&server, "Anna").await;
    let list = until_class(&session, 1).await;
    server.signal(nix::sys::signal::Signal::SIGKILL);
    server.ended().await;
    until_class(&session, 0).await;
    let path = format!("/simulations/{}/stop", list[0]["id"].as_str().unwrap());
    assert_eq!(send(&session, &path, TOKEN, &json!({})).await.0, 404);
}

/// The text of the events of the page, until this is in it. Returns it, and the number of bytes that were received.
async fn events(session: &Server, headers: &[(&str, &str)], wanted: &str) -> (String, usize) {
    let client = awc::Client::builder().disable_timeout().finish();
    let request = client.get(session.url("/class/events")).basic_auth("admin", PASSWORD);
    let request = headers.iter().fold(request.no_decompress(), |request, header| {
        request.insert_header(*header)
    });
    let mut answer = request.send().await.unwrap();
    assert_eq!(answer.status(), 200);
    let mut bytes = Vec::new();
    let read = async {
        loop {
            bytes.extend(answer.next().await.unwrap().unwrap());
            let mut text = String::new();
            if answer.headers().contains_key("content-encoding") {
                // It has no end yet.
                let mut read = Vec::new();
                MultiGzDecoder::new(&*bytes).read_to_end(&mut read).ok();
                text = String::from_utf8_lossy(&read).into_owned();
            } else {
                text.push_str(&String::from_utf8_lossy(&bytes));
            }
            if text.contains(wanted) {
                return (text, bytes.len());
            }
        }
    };
    actix_rt::time::timeout(SOON, read)
        .await
        .unwrap_or_else(|_| panic!("no {wanted}"))
}

#[actix_rt::test]
async fn a_page_is_told_what_has_changed() {
    let server = keyed(3).start().await;
    let session = fleet(&[server.address()]).await;
    let _first = start(&server, "Anna").await;
    until_class(&session, 1).await;
    let (text, _) = events(&session, &[], "Anna").await;
    assert!(
        text.contains("\"all\":true") && text.contains("\"servers\":[{"),
        "{text}"
    );
    let id = text
        .lines()
        .find_map(|line| line.strip_prefix("id: "))
        .unwrap()
        .to_owned();
    // A page that comes back is told what is new.
    let second = start(&server, "Ben").await;
    until_class(&session, 2).await;
    let (text, _) = events(&session, &[("Last-Event-ID", &id)], "Ben").await;
    assert!(text.contains("\"all\":false") && text.contains(second.id()), "{text}");
    let (text, _) = events(&session, &[("Last-Event-ID", "7-7")], "Ben").await;
    assert!(
        text.contains("\"all\":true") && text.contains("Anna"),
        "that of another run: {text}"
    );
    let (text, _) = events(&session, &[("Accept-Encoding", "gzip")], "Ben").await;
    assert!(text.contains("Anna"), "{text}");
    // Somebody looks, so there are figures.
    let (text, _) = events(&session, &[], "\"cpu\":").await;
    assert!(text.contains("\"cpu\":"), "{text}");
    // Strangers and other sites get nothing.
    for path in ["/class/events", "/simulations", "/class"] {
        assert_eq!(
            crate::support::http::get(&session.url(path)).await.status,
            401,
            "{path}"
        );
    }
}

/// The simulations of one of four servers in a round: one of ten has other figures than in the round before.
fn told(server: u32, round: u32) -> Vec<SimulationReport> {
    let one = |number: u32| SimulationReport {
        id: format!("2026-11-24T10-00-{server}-{number}"),
        world: format!("https://github.com/lab/arm/blob/main/worlds/world{}.wbt", number % 5),
        user: Some(format!("student{:03}@school.example", 250 * server + number)),
        label: None,
        state: Stage::Running,
        since: 1_795_000_000 + u64::from(server + 7 * number),
        waited: Some(0.0),
        away_until: None,
        cpu: Some(5 * ((number * number + (round + number) / 10) % 20)),
        real_time: Some(100 - 5 * ((number + (round + number) / 10) % 4)),
    };
    let is_new = |number: &u32| round == 0 || (round + number).is_multiple_of(10);
    (0..250).filter(is_new).map(one).collect()
}

/// A session server with 1,000 simulations on four servers, of which a tenth changes each second.
async fn large_class() -> Server {
    let mut servers = Vec::new();
    for _ in 0..4 {
        servers.push(ReservingServer::start(1000, 10.0).await);
    }
    let addresses: Vec<String> = servers.iter().map(|server| server.address.clone()).collect();
    let session = fleet(&addresses).await;
    for (number, mut server) in (0..).zip(servers) {
        let mut link = server.link().await;
        actix_rt::spawn(async move {
            let mut seconds = actix_rt::time::interval(Duration::from_secs(1));
            for round in 0.. {
                let update = ToSessionServer::Roster(RosterUpdate {
                    all: round == 0,
                    simulations: told(number, round),
                    ended: Vec::new(),
                });
                let until_next = async {
                    tokio::select! {
                        _ = seconds.tick() => true,
                        () = async { while link.wishes_if_any().await.is_some() {} } => false,
                    }
                };
                if !until_next.await || !link.say(serde_json::to_string(&update).unwrap()).await {
                    return server;
                }
            }
            server
        });
    }
    until_class(&session, 1000).await;
    session
}

#[actix_rt::test]
async fn the_page_of_a_large_class_gets_20_kib_at_first_and_then_changes() {
    let session = large_class().await;
    let gzip = ("Accept-Encoding", "gzip");
    let (text, bytes) = events(&session, &[gzip], "\"gone\":[]").await;
    assert!(text.contains("\"all\":true"), "{text}");
    assert!(bytes <= 20 * 1024, "{bytes} bytes");
    let id = text
        .lines()
        .find_map(|line| line.strip_prefix("id: "))
        .unwrap()
        .to_owned();
    let (text, changes) = events(&session, &[gzip, ("Last-Event-ID", &id)], "\"gone\":[]").await;
    assert!(text.contains("\"all\":false"), "{text}");
    assert!(changes < bytes / 4, "{changes} bytes of {bytes}");
}

#[actix_rt::test]
async fn on_a_quiet_machine_the_page_of_a_large_class_costs_two_percent_of_a_core() {
    const TIME: Duration = Duration::from_secs(20);
    let session = large_class().await;
    let percent = async || {
        let used = || {
            let stat = procfs::process::Process::new(session.pid()).unwrap().stat().unwrap();
            (stat.utime + stat.stime) as f64 / procfs::ticks_per_second() as f64
        };
        let (before, begin) = (used(), Instant::now());
        actix_rt::time::sleep(TIME).await;
        100.0 * (used() - before) / begin.elapsed().as_secs_f64()
    };
    let without = percent().await;
    let client = awc::Client::builder().disable_timeout().finish();
    let request = client.get(session.url("/class/events")).basic_auth("admin", PASSWORD);
    let mut answer = request
        .no_decompress()
        .insert_header(("Accept-Encoding", "gzip"))
        .send()
        .await
        .unwrap();
    let read = async {
        let mut bytes = 0;
        let end = actix_rt::time::sleep(TIME);
        tokio::pin!(end);
        loop {
            tokio::select! {
                chunk = answer.next() => bytes += chunk.unwrap().unwrap().len(),
                () = &mut end => return bytes,
            }
        }
    };
    let (with, bytes) = futures_util::future::join(percent(), read).await;
    let figures = format!("{without:.2} % without, {with:.2} % with a reader, who got {bytes} bytes in 20 s");
    eprintln!("{figures}");
    assert!(with - without <= 2.0, "{figures}");
}

#[actix_rt::test]
async fn servers_that_tell_nothing_are_shown_as_what_they_are() {
    let python = StandIn::start(Manner::Load("3.0".to_owned()));
    let alone = demo_server(1).start().await;
    let foreign = demo_server(1).set("fleetKey", "another key for a fleet").start().await;
    let known = keyed(1).start().await;
    let servers = [python.address(), alone.address(), foreign.address(), known.address()];
    let session = fleet(&servers).await;
    until_states(&session, &["up", "up", "up", "up"]).await;
    let _hidden = start(&alone, "Anna").await;
    let _seen = start(&known, "Ben").await;
    let list = until_class(&session, 1).await;
    assert_eq!(list[0]["label"], "Ben");
    let mut lines = Value::Null;
    until("its servers are known", async || {
        let (text, _) = events(&session, &[], "\"servers\":").await;
        let event = text.lines().find_map(|line| line.strip_prefix("data: ")).unwrap();
        lines = serde_json::from_str::<Value>(event).unwrap()["servers"].clone();
        lines
            .as_array()
            .is_some_and(|lines| lines.iter().filter(|line| line["note"] == "").count() == 1)
    })
    .await;
    for (number, note) in [
        (0, "as the Python server"),
        (1, "no fleetKey"),
        (2, "fleetKey is another one"),
        (3, ""),
    ] {
        let said = lines[number]["note"].as_str().unwrap();
        assert!(
            said.contains(note) && (note.is_empty() == said.is_empty()),
            "{number}: {said}"
        );
    }
}

#[actix_rt::test]
async fn an_administrator_signs_in_once_for_the_whole_fleet() {
    let server = keyed(1).start().await;
    let session = fleet(&[server.address()]).await;
    let client = start(&server, "Anna").await;
    until_class(&session, 1).await;
    let get = async |url: String, headers: &[(&str, &str)]| {
        let client = awc::Client::builder().disable_redirects().finish();
        let request = headers
            .iter()
            .fold(client.get(url), |request, header| request.insert_header(*header));
        let mut answer = request.send().await.unwrap();
        let text = |name| {
            answer
                .headers()
                .get(name)
                .map(|value| value.to_str().unwrap().to_owned())
        };
        let (to, cookie) = (text("location"), text("set-cookie"));
        let body = answer.body().await.unwrap();
        (
            answer.status().as_u16(),
            to,
            cookie,
            String::from_utf8_lossy(&body).into_owned(),
        )
    };
    let token = format!("Bearer {TOKEN}");
    let reader = format!("Bearer {READER}");
    let visit = session.url(&format!("/visit?id={}", client.id()));
    assert_eq!(get(visit.clone(), &[]).await.0, 401);
    // What leads to an entry must not give a program more than it may.
    assert_eq!(get(visit.clone(), &[("Authorization", &reader)]).await.0, 403);
    let (status, to, ..) = get(visit, &[("Authorization", &token)]).await;
    let to = to.unwrap();
    assert_eq!(status, 303);
    assert!(to.starts_with(&server.url("/sign-in?entry=")), "{to}");
    let (status, _, cookie, page) = get(to.clone(), &[]).await;
    assert_eq!(status, 200);
    assert!(page.contains(&format!("0; url=watch?id={}", client.id())), "{page}");
    let cookie = cookie.unwrap().split(';').next().unwrap().to_owned();
    let watch = server.url(&format!("/watch?id={}", client.id()));
    let (status, _, _, page) = get(watch.clone(), &[("Cookie", &cookie)]).await;
    assert_eq!(status, 200, "{page}");
    // The page links back to the class.
    assert!(page.contains("/class\" data-words=\"class\""), "{page}");
    assert_eq!(
        get(watch, &[]).await.0,
        403,
        "without a password nobody can sign in here otherwise"
    );
    // No other server takes the entry: the one for which it is may be without the key, and show it to others.
    let second = keyed(1).start().await;
    for other in [second.url(""), session.url("")] {
        let other = other.trim_end_matches('/');
        let (_, _, cookie, _) = get(to.replace(server.url("").trim_end_matches('/'), other), &[]).await;
        assert_eq!(cookie, None, "{other}");
    }
    // Another entry, and a server with another key.
    let forged = to.replacen("entry=", "entry=A", 1);
    assert_eq!(get(forged, &[]).await.1.as_deref(), Some("sign-in"));
    let foreign = demo_server(1).set("fleetKey", "another key for a fleet").start().await;
    let elsewhere = to.replace(&server.address(), &foreign.address());
    assert_eq!(get(elsewhere, &[]).await.1.as_deref(), Some("sign-in"));
    let (status, to, ..) = get(
        session.url(&format!("/visit?server={}", server.address())),
        &[("Authorization", &token)],
    )
    .await;
    assert!(status == 303 && to.unwrap().contains("to=monitor"));
    let evil = session.url("/visit?server=evil.example");
    assert_eq!(get(evil, &[("Authorization", &token)]).await.0, 404);
}

#[actix_rt::test]
async fn a_lesson_is_one_list_of_all_servers() {
    let servers = [keyed(2).start().await, keyed(2).start().await];
    let python = StandIn::start(Manner::Load("3.0".to_owned()));
    let [first, second] = servers.each_ref().map(Server::address);
    let session = fleet(&[first.clone(), second.clone(), python.address()]).await;
    let mut ids = Vec::new();
    for (server, name) in [(&servers[0], "Anna"), (&servers[1], "=1+1"), (&servers[0], "Ben")] {
        let client = start(server, name).await;
        ids.push(client.id().to_owned());
        client.leave().await;
    }
    let mut text = String::new();
    until("all have ended", async || {
        let answer = get_as_administrator(&session.url("/simulations.csv")).await;
        assert_eq!(answer.header("webots-missing"), Some(python.address().as_str()));
        text = answer.text();
        text.lines().count() == 4
    })
    .await;
    let lines: Vec<&str> = text.lines().collect();
    assert!(
        lines[0].ends_with(",waited (s),duration (s),real time (%),below 0.9 of real time (% of the time),server"),
        "{text}"
    );
    // By their beginnings, in seconds.
    assert!(lines[1..].is_sorted_by_key(|line| line.split(',').nth(1)), "{text}");
    for (id, (server, name)) in ids.iter().zip([(&first, "Anna"), (&second, "'=1+1"), (&first, "Ben")]) {
        let line = lines.iter().find(|line| line.starts_with(id.as_str())).unwrap();
        assert!(line.ends_with(&format!(",{server}")), "{text}");
        assert!(line.contains(&format!("\"{name}\"")), "{line}");
        let duration = line.rsplit(',').nth(3).unwrap();
        assert!(duration.parse::<u64>().is_ok(), "{line}");
    }
    // A list that is cut off is none.
    let cut = format!("HTTP/1.1 200 OK\r\nContent-Length: 9999\r\n\r\n{}\n20261", lines[0]);
    python.set(Manner::RawRecords(cut.into_bytes()));
    let answer = get_as_administrator(&session.url("/simulations.csv")).await;
    assert_eq!(answer.header("webots-missing"), Some(python.address().as_str()));
    assert_eq!(answer.text(), text);
    // A server without the key has seen the token with which its records were requested. It reads, and does nothing else.
    let token = python.token().unwrap();
    let bearer = format!("Bearer {token}");
    let get = async |path: &str| {
        let client = awc::Client::builder().disable_redirects().finish();
        let request = client
            .get(servers[0].url(path))
            .insert_header(("Authorization", bearer.as_str()));
        request.send().await.unwrap()
    };
    assert_eq!(get("/simulations.csv").await.status(), 200);
    let entered = get(&format!("/sign-in?entry={token}")).await;
    let headers = entered.headers();
    assert_eq!(headers.get("location").map(|to| to.to_str().unwrap()), Some("sign-in"));
    assert!(headers.get("set-cookie").is_none(), "{headers:?}");
    let (status, text) = send(
        &servers[0],
        &format!("/simulations/{}/stop", ids[0]),
        &token,
        &json!({}),
    )
    .await;
    assert_eq!((status, text.as_str()), (403, "Error: this token may only read."));
    let past = get_as_administrator(&session.url("/simulations.csv?from=0&to=1000")).await;
    assert_eq!(past.text().lines().count(), 1, "{}", past.text());
    // Of one server, for session servers only while it has no password.
    let own = servers[0].url("/simulations.csv");
    assert_eq!(get_as_administrator(&own).await.status, 403);
    assert_eq!(
        crate::support::http::get(&session.url("/simulations.csv")).await.status,
        401
    );
}

#[actix_rt::test]
async fn how_fast_a_simulation_runs_is_told_and_recorded() {
    let server = keyed(1).set("streaming", "relay").start().await;
    let session = fleet(&[server.address()]).await;
    let mut client = Client::connect(&server.websocket("/client")).await;
    client.send(&json!({"start": {"url": arm()}}).to_string()).await;
    let told = client.until("webots:").await;
    let (_, path) = told.split_once("/stream/").unwrap();
    let viewer = Client::connect(&server.websocket(&format!("/stream/{path}"))).await;
    let mut viewer = viewer.with_running_scene().await;
    let read = async { while viewer.time().await >= 0.0 {} };
    let (text, _) = tokio::select! {
        () = read => unreachable!("the stream has no end"),
        told = events(&session, &[], "\"realTime\":") => told,
    };
    let factor = text.split("\"realTime\":").nth(1).unwrap();
    let factor: u32 = factor.split([',', '}']).next().unwrap().parse().unwrap();
    assert!((5..=200).contains(&factor) && factor.is_multiple_of(5), "{factor}");
    drop(viewer);
    client.leave().await;
    until("it is recorded", async || {
        let text = get_as_administrator(&session.url("/simulations.csv")).await.text();
        text.lines()
            .nth(1)
            .and_then(|line| line.rsplit(',').nth(2)?.parse::<u32>().ok())
            .is_some_and(|percent| (1..=200).contains(&percent))
    })
    .await;
}

#[actix_rt::test]
async fn an_upgrade_of_a_simulation_server_is_no_failure() {
    let server = keyed(4).start().await;
    let session = fleet(&[server.address()]).await;
    until_states(&session, &["up"]).await;
    let mut waiting = Client::connect(&session.websocket("/session")).await;
    assert_eq!(waiting.until("").await, "1");
    let changes = session.status().await["changes"].clone();
    let mut students = Vec::new();
    for count in 1..=3 {
        students.push(start(&server, "Nora").await);
        let (succeeds, told) = server.upgrade().await;
        assert!(succeeds, "{told}");
        until("the whole class is listed", async || {
            let list = class(&session).await;
            list.len() == count
                && list
                    .iter()
                    .all(|one| one["state"] == "idle" || one["state"] == "running")
        })
        .await;
    }
    // One of the oldest process is stopped through the newest, which has a link now: before, the list was that of the one before.
    let links = || server.log().matches("is a session server, for whose line").count();
    until("each process has had a link", async || links() == 4).await;
    until_class(&session, 3).await;
    let path = format!("/simulations/{}/stop", students[0].id());
    let (status, text) = send(&session, &path, TOKEN, &json!({})).await;
    assert_eq!(status, 202, "{text}");
    students[0].until(TOLD).await;
    until_class(&session, 2).await;
    assert_eq!(session.status().await["changes"], changes);
    assert!(
        waiting.is_silent(std::time::Duration::from_secs(1)).await,
        "{:?}",
        waiting.heard
    );
    // The line gives its clients slots of the newest.
    let mut line = Client::connect(&session.websocket("/session")).await;
    line.send(&json!({"url": arm(), "wait": true}).to_string()).await;
    line.until("pass: ").await;
}
