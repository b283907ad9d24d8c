//! A fleet that keeps simulations ready: who keeps how many, and that clients are sent where one is.

use serde_json::{Value, json};
use webots_fleet::shared::domain::ReadyCount;

use crate::support::client::Client;
use crate::support::git::{Forge, arm};
use crate::support::http::{self, PASSWORD, post};
use crate::support::program::{Builder, Server, demo_server, session_server, simulation_server};
use crate::support::reserving::ReservingServer;
use crate::support::webots::Webots;
use crate::support::{ready_class, until};

const SECRET: &str = "a secret of this test";

/// Simulation servers with these numbers of slots, which keep simulations ready however busy the machine is.
struct Site {
    servers: Vec<Server>,
    _parts: (Forge, Webots),
}

impl Site {
    async fn new(slots: &[u16]) -> Self {
        let forge = Forge::with_arm();
        let webots = Webots::launcher();
        let mut servers = Vec::new();
        for slots in slots {
            let server = simulation_server(&webots.path(), forge.path(), *slots)
                .set("fleetKey", SECRET)
                .set("readyLoad", 1000)
                .set("timing.branches", 0.5);
            servers.push(server.start().await);
        }
        Self {
            servers,
            _parts: (forge, webots),
        }
    }

    fn session(&self) -> Builder {
        let addresses: Vec<String> = self.servers.iter().map(Server::address).collect();
        session_server(&addresses)
            .set("fleetKey", SECRET)
            .set("loadThreshold", 1000)
            .set("adminPassword", PASSWORD)
    }

    /// The number that each server has ready.
    async fn ready(&self) -> Vec<u64> {
        let mut ready = Vec::new();
        for server in &self.servers {
            ready.push(server.status().await["ready"][0]["ready"].as_u64().unwrap_or_default());
        }
        ready
    }

    async fn until_ready(&self, expected: &[u64]) {
        until(&format!("{expected:?} are ready"), async || {
            self.ready().await == expected
        })
        .await;
    }
}

/// Waits until the session server knows of this many.
async fn until_known(session: &Server, count: u64) {
    let knows = async || session.status().await["ready"][0]["ready"] == count;
    until(&format!("{count} are known"), knows).await;
}

fn list(count: u32) -> Value {
    json!([{"world": arm(), "count": count}])
}

/// A client's simulation of the world of [`arm`] on this server: whether it was there already.
async fn is_there(url: &str, pass: &str) -> (bool, Client) {
    let mut client = Client::connect(&format!("{url}/client")).await;
    let mut start = json!({"url": arm()});
    if !pass.is_empty() {
        start["pass"] = pass.into();
    }
    client.send(&json!({ "start": start }).to_string()).await;
    client.until("webots:").await;
    let has_started = client
        .heard
        .iter()
        .any(|text| text.starts_with("loading: webots is starting"));
    (!has_started, client)
}

#[actix_rt::test]
async fn each_server_keeps_its_share_and_clients_are_sent_where_one_is() {
    let site = Site::new(&[4, 2]).await;
    let session = site.session().set("ready", list(3)).start().await;
    site.until_ready(&[2, 1]).await;
    until_known(&session, 3).await;
    let status = session.status().await;
    assert_eq!(
        status["ready"],
        json!([{"world": arm(), "mode": "x3d", "wanted": 3, "ready": 3}])
    );
    assert_eq!(status["servers"][0]["ready"][0]["ready"], 2);
    assert!(session.monitor().await.contains("kept ready"));
    // Two come in the line, and one without: none waits for a start.
    let mut clients = Vec::new();
    for number in 0..3 {
        let (url, pass) = if number < 2 {
            let mut line = Client::connect(&session.websocket("/session")).await;
            line.send(&json!({"url": arm(), "wait": true}).to_string()).await;
            let pass = line.until("pass: ").await;
            (line.until("ws://").await, pass["pass: ".len()..].to_owned())
        } else {
            (
                http::get(&session.url(&format!("/session?url={}", arm()))).await.text(),
                String::new(),
            )
        };
        let (is_there, client) = is_there(&url, &pass).await;
        assert!(is_there, "client {number}: {:?}", client.heard);
        clients.push(client);
    }
    // The list is read again.
    session.reload(json!({"ready": []}));
    site.until_ready(&[0, 0]).await;
}

#[actix_rt::test]
async fn a_long_list_is_kept_too() {
    let site = Site::new(&[2]).await;
    // Those with 0 are for another time; all together are longer than a client's message may be.
    let mut list = vec![json!({"world": arm(), "count": 1})];
    list.extend((0..300).map(|number| {
        let world = crate::support::world("lab/arm", "main", &format!("worlds/of_another_lesson_{number}.wbt"));
        json!({"world": world, "count": 0})
    }));
    let session = site.session().set("ready", list).start().await;
    site.until_ready(&[1]).await;
    // The line has its link, too.
    let mut line = Client::connect(&session.websocket("/session")).await;
    line.send(&json!({"url": arm(), "wait": true}).to_string()).await;
    line.until("pass: ").await;
}

#[actix_rt::test]
async fn a_lesson_is_requested_until_its_end_and_outlives_a_restart() {
    let site = Site::new(&[4]).await;
    let folder = tempfile::tempdir().unwrap();
    let mut session = site.session().folder(folder.path()).start().await;
    let ready = async |session: &Server, password: Option<&str>, body: Value| {
        post(&session.url("/ready"), password, &body.to_string()).await
    };
    let lesson = |count: u32| json!({"world": arm(), "count": count, "until": "2999-01-01T09:30", "timeZone": "UTC"});
    assert_eq!(ready(&session, None, lesson(2)).await, 401);
    assert_eq!(
        ready(&session, Some(PASSWORD), json!({"world": arm(), "count": 2})).await,
        400
    );
    assert_eq!(
        ready(
            &session,
            Some(PASSWORD),
            json!({"world": "x", "count": 2, "until": "2999-01-01"})
        )
        .await,
        400
    );
    assert_eq!(ready(&session, Some(PASSWORD), lesson(2)).await, 200);
    site.until_ready(&[2]).await;
    session.stops().await;
    let session = site.session().folder(folder.path()).start().await;
    until_known(&session, 2).await;
    assert_eq!(session.status().await["requested"][0]["count"], 2);
    // The same world again replaces the entry, and 0 ends it.
    assert_eq!(ready(&session, Some(PASSWORD), lesson(1)).await, 200);
    site.until_ready(&[1]).await;
    assert_eq!(ready(&session, Some(PASSWORD), lesson(0)).await, 200);
    until("none is kept", async || {
        site.servers[0].status().await["instances"]["spare"] == 0
    })
    .await;
    // One in the past is refused, and one ends when its time comes.
    let until_then = |until: &str| json!({"world": arm(), "count": 1, "until": until});
    assert_eq!(ready(&session, Some(PASSWORD), until_then("2020-01-01")).await, 400);
    assert_eq!(session.status().await["ready"], json!([]));
    let soon = jiff::Timestamp::now() + std::time::Duration::from_secs(5);
    assert_eq!(
        ready(&session, Some(PASSWORD), until_then(&soon.to_string())).await,
        200
    );
    assert_eq!(session.status().await["ready"][0]["wanted"], 1);
    until("it is over", async || session.status().await["ready"] == json!([])).await;
    assert!(jiff::Timestamp::now() >= soon);
}

#[actix_rt::test]
async fn a_server_that_is_full_of_them_takes_clients_of_other_worlds() {
    let site = Site::new(&[2]).await;
    let session = site.session().set("ready", list(2)).start().await;
    site.until_ready(&[2]).await;
    until_known(&session, 2).await;
    let mut states = Client::connect(&session.websocket("/session")).await;
    assert_eq!(states.until("").await, "1", "its slots are as good as free");
    site._parts
        .0
        .commit("lab/other", "main", &[("worlds/o.wbt", crate::support::WORLD)]);
    let other = crate::support::world("lab/other", "main", "worlds/o.wbt");
    let mut clients = Vec::new();
    for _ in 0..2 {
        let mut line = Client::connect(&session.websocket("/session")).await;
        line.send(&json!({"url": other, "wait": true}).to_string()).await;
        let pass = line.until("pass: ").await["pass: ".len()..].to_owned();
        let url = line.until("ws://").await;
        let mut client = Client::connect(&format!("{url}/client")).await;
        client
            .send(&json!({"start": {"url": other, "pass": pass}}).to_string())
            .await;
        client.until("webots:").await;
        clients.push(client);
    }
    assert_eq!(states.until("0").await, "0");
    assert_eq!(site.servers[0].status().await["instances"]["spare"], 0);
}

#[actix_rt::test]
async fn a_server_that_only_shares_idle_time_keeps_its_share_at_any_load() {
    let mut server = ReservingServer::start(4, 10.0).await;
    let shares = |load: u32| json!({"load": load, "docker": true, "shareIdleTime": 50});
    server.report_also(shares(10));
    let session = session_server(&[server.address.clone()])
        .set("fleetKey", SECRET)
        .set("adminPassword", PASSWORD)
        .set("ready", list(1))
        .start()
        .await;
    let mut link = server.link().await;
    let count = |list: Vec<ReadyCount>| list.into_iter().map(|one| one.count).collect::<Vec<_>>();
    while count(link.keep_ready().await) != [1] {}
    for (load, wanted) in [(60, 2), (10, 3), (60, 4)] {
        server.report_also(shares(load));
        until("its load is known", async || {
            session.status().await["servers"][0]["load"] == f64::from(load)
        })
        .await;
        // That changes nothing: the next list is that of a lesson.
        let lesson = json!({"world": arm(), "count": wanted, "until": "2999-01-01"});
        assert_eq!(
            post(&session.url("/ready"), Some(PASSWORD), &lesson.to_string()).await,
            200
        );
        assert_eq!(count(link.keep_ready().await), [wanted], "at a load of {load} %");
    }
}

/// The figures of docs/ready.md: `cargo test on_a_quiet_machine_a_class_finds -- --nocapture` prints them.
#[actix_rt::test]
async fn on_a_quiet_machine_a_class_finds_its_world_ready() {
    needs!("bwrap");
    for level in ["none", "sandbox"] {
        ready_class::compare(level, || demo_server(ready_class::SLOTS).set("isolation", level)).await;
    }
}
