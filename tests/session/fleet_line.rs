//! The line of a whole fleet: real simulation servers, and clients that come, wait, reload, stay and leave.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant, SystemTime};

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use nix::sys::signal::Signal;
use serde_json::json;

use super::stand_in::{Manner, StandIn};
use super::until_states;
use crate::support::client::{Client, Heard};
use crate::support::git::{Forge, WORLD, arm, world};
use crate::support::program::{Builder, Server, demo_server, session_server, simulation_server};
use crate::support::webots::Webots;
use crate::support::{SOON, until};

const SECRET: &str = "a secret of this test";
const SLOTS: u16 = 5;
/// Tolerance of the clocks of this test: it sees a change later than the server that makes it.
const SEEN: Duration = Duration::from_millis(300);

/// A client's time in the line, as the client knows it.
#[derive(Debug, Clone)]
struct Wait {
    /// The place in its ticket: the time of its arrival, and its number.
    place: (u64, u64),
    owner: &'static str,
    from: SystemTime,
    /// When it was over, and the server, if it was the client's turn.
    until: SystemTime,
    server: Option<String>,
}

/// What all clients do.
#[derive(Default)]
struct Class {
    waits: RefCell<Vec<Wait>>,
    /// The addresses of Webots that are in use.
    held: RefCell<BTreeSet<String>>,
    served: Cell<usize>,
    /// Number of turns that led to no simulation, because the server was gone.
    lost_turns: Cell<usize>,
}

/// One client.
struct Visitor<'class> {
    class: &'class Class,
    session: String,
    owner: &'static str,
    ticket: String,
    /// Whether a turn has come with its ticket, which may be worth nothing since then.
    had_turn: bool,
    stay: Duration,
    /// Whether it reloads its page while it waits.
    reloads: bool,
}

/// The time of arrival in a ticket, and its number.
pub(super) fn place(ticket: &str) -> (u64, u64) {
    let bytes = URL_SAFE_NO_PAD.decode(ticket).unwrap();
    let number = |at: usize| u64::from_be_bytes(bytes[at..at + 8].try_into().unwrap());
    (number(0), number(8))
}

impl Visitor<'_> {
    fn world(&self) -> String {
        world(&format!("{}/arm", self.owner), "main", "worlds/a.wbt")
    }

    async fn visit(mut self) {
        loop {
            let Some((server, pass)) = self.turn().await else {
                actix_rt::time::sleep(Duration::from_millis(100)).await;
                continue;
            };
            if self.simulate(&server, &pass).await {
                self.class.served.set(self.class.served.get() + 1);
                return;
            }
            self.class.lost_turns.set(self.class.lost_turns.get() + 1);
            actix_rt::time::sleep(Duration::from_millis(100)).await;
        }
    }

    /// Waits for its turn. Returns `None` if the connection ends before.
    async fn turn(&mut self) -> Option<(String, String)> {
        let mut line = Client::try_connect(&self.session).await.ok()?;
        let request = json!({"url": self.world(), "wait": true, "ticket": self.ticket});
        line.try_send(&request.to_string()).await.ok()?;
        let before = (!self.had_turn && !self.ticket.is_empty()).then(|| place(&self.ticket));
        let mut from = None;
        let mut pass = String::new();
        let turn = loop {
            match line.next_within(Duration::from_secs(90)).await.expect("a sign of life") {
                Heard::Closed(_) => break None,
                Heard::Text(text) => match text.split_once(": ").unwrap_or((&text, "")) {
                    ("ticket", ticket) => {
                        from.get_or_insert_with(SystemTime::now);
                        ticket.clone_into(&mut self.ticket);
                        let kept = place(&self.ticket);
                        assert_eq!(before.unwrap_or(kept), kept, "it has lost its place");
                    }
                    ("queue", ahead) => {
                        let position: usize = ahead.parse().unwrap();
                        if self.reloads && position < 60 {
                            self.reloads = false;
                            break None;
                        }
                    }
                    ("pass", given) => given.clone_into(&mut pass),
                    ("Error", why) => panic!("{why}"),
                    _ if text.starts_with("ws://") => break Some((text, pass)),
                    _ => {}
                },
            }
        };
        self.had_turn |= turn.is_some();
        if let Some(from) = from {
            self.class.waits.borrow_mut().push(Wait {
                place: place(&self.ticket),
                owner: self.owner,
                from,
                until: SystemTime::now(),
                server: turn.as_ref().map(|(server, _)| server.clone()),
            });
        }
        turn
    }

    /// Runs a simulation; returns whether it ran to its end.
    async fn simulate(&self, server: &str, pass: &str) -> bool {
        let Ok(mut client) = Client::try_connect(&format!("{server}/client")).await else {
            println!("{server}: no connection {:?} {pass}", place(&self.ticket));
            return false;
        };
        assert!(!pass.is_empty(), "{server} reserves slots");
        let request = json!({"start": {"url": self.world(), "pass": pass}});
        if client.try_send(&request.to_string()).await.is_err() {
            return false;
        }
        let url = loop {
            match client.next_within(SOON).await {
                Some(Heard::Text(text)) if text.starts_with("webots:") => break text,
                Some(Heard::Text(text)) => assert!(!text.starts_with("queue:"), "{server}: a slot is given twice"),
                other => {
                    println!("{server}: {other:?} {:?}", client.heard);
                    return false;
                }
            }
        };
        assert!(self.class.held.borrow_mut().insert(url.clone()), "{url} is another's");
        actix_rt::time::sleep(self.stay).await;
        self.class.held.borrow_mut().remove(&url);
        client.leave().await;
        true
    }
}

impl Class {
    /// The pairs of clients of which the second had its turn before the first, although both waited, the first had come
    /// earlier, and the server could take both, by more than this time.
    fn overtakings(&self, takes: &BTreeMap<String, &[&str]>, tolerance: Duration) -> Vec<(Wait, Wait)> {
        let waits = self.waits.borrow();
        let mut found = Vec::new();
        for turn in waits.iter().filter(|wait| wait.server.is_some()) {
            let takes = takes[turn.server.as_ref().unwrap()];
            let was_passed_over = |other: &&Wait| {
                other.place < turn.place
                    && takes.contains(&other.owner)
                    && other.from + tolerance < turn.until
                    && other.until > turn.until + tolerance
            };
            found.extend(
                waits
                    .iter()
                    .filter(was_passed_over)
                    .map(|other| (other.clone(), turn.clone())),
            );
        }
        found
    }

    /// How long each slot that became free was so, while somebody waited who could use it, by the log of its server.
    fn idle(&self, server: &Server, owners: &[&str]) -> Vec<Duration> {
        let waits = self.waits.borrow();
        let mut free: BTreeMap<&str, SystemTime> = BTreeMap::new();
        let mut idle = Vec::new();
        let log = server.log();
        for line in log.lines() {
            let Some((_, rest)) = line.split_once("the slot of port ") else {
                continue;
            };
            let (port, what) = rest.split_once(' ').unwrap();
            let at = humantime::parse_rfc3339(line.split(' ').next().unwrap()).unwrap();
            if what.starts_with("is free") {
                free.insert(port, at);
            } else if let Some(since) = free.remove(port) {
                let could_use = |wait: &&Wait| owners.contains(&wait.owner) && wait.from < since && wait.until >= at;
                if waits.iter().any(|wait| could_use(&wait)) {
                    idle.push(at.duration_since(since).unwrap_or_default());
                }
            }
        }
        idle
    }
}

fn server(forge: &Forge, webots: &Webots, owners: &[&str]) -> Builder {
    let allowed: Vec<_> = owners
        .iter()
        .map(|owner| format!("https://github.com/{owner}"))
        .collect();
    simulation_server(&webots.path(), forge.path(), SLOTS)
        .set("allowedRepositories", json!(allowed))
        .set("isolation", "none")
        .set("fleetKey", SECRET)
}

fn fleet(addresses: &[String]) -> Builder {
    session_server(addresses)
        .set("fleetKey", SECRET)
        .set("loadThreshold", 1000)
}

/// A client of an address in the line for the world of `arm`.
async fn enter_from(session: &Server, address: &str) -> Client {
    let url = session.websocket("/session");
    let mut client = Client::with_headers(&url, &[("x-forwarded-for", address)])
        .await
        .unwrap();
    client.send(&json!({"url": arm(), "wait": true}).to_string()).await;
    client.until("ticket: ").await;
    client
}

/// The next pass of a client whose turn comes.
async fn pass(client: &mut Client) -> String {
    client.until("pass: ").await.replace("pass: ", "")
}

#[actix_rt::test]
async fn a_flood_of_tickets_of_one_address_takes_no_turn_of_others() {
    let server = demo_server(2)
        .set("fleetKey", SECRET)
        .set("maxPlacesPerAddress", 1)
        .start()
        .await;
    let session = fleet(&[server.address()]).start().await;
    until_states(&session, &["up"]).await;
    let (flooding, other) = ("203.0.113.9", "203.0.113.10");
    let mut flood = Vec::new();
    for _ in 0..40 {
        flood.push(enter_from(&session, flooding).await);
    }
    let start = async |address: &str, pass: &str| {
        let mut client = Client::from_address(&server, address).await.unwrap();
        let request = json!({"start": {"url": arm(), "pass": pass}});
        client.send(&request.to_string()).await;
        client.until("webots:").await;
        client
    };
    let first = start(flooding, &pass(&mut flood[0]).await).await;
    // The second slot stays free for others, although forty came before.
    let mut client = enter_from(&session, other).await;
    let given = pass(&mut client).await;
    let second = start(other, &given).await;
    // Those of the flood have kept their order, and get what their address may have.
    first.leave().await;
    start(flooding, &pass(&mut flood[1]).await).await.leave().await;
    pass(&mut flood[2]).await;
    second.leave().await;
}

#[actix_rt::test]
async fn a_python_server_among_others_takes_its_turn_by_the_load_alone() {
    // The original's simulation server has `/load` and no `/status`, and knows neither slots nor passes.
    let python = StandIn::start(Manner::Load("200.0".to_owned()));
    let server = demo_server(1).set("fleetKey", SECRET).start().await;
    let inside = Client::ready(&server).await;
    let session = fleet(&[server.address(), python.address()])
        // The load of this machine fills no server.
        .set("loadThreshold", 150)
        .start()
        .await;
    until_states(&session, &["full", "full"]).await;
    let mut first = enter_from(&session, "203.0.113.9").await;
    assert_eq!(first.until("queue: ").await, "queue: 0");
    python.set(Manner::Load("3.0".to_owned()));
    assert_eq!(first.until("ws://").await, python.url());
    assert!(
        !first.heard.iter().any(|text| text.starts_with("pass:")),
        "{:?}",
        first.heard
    );
    python.set(Manner::Load("200.0".to_owned()));
    until_states(&session, &["full", "full"]).await;
    let mut second = enter_from(&session, "203.0.113.9").await;
    assert_eq!(second.until("queue: ").await, "queue: 0");
    inside.leave().await;
    pass(&mut second).await;
    assert_eq!(second.until("ws://").await, format!("ws://{}", server.address()));
}

#[actix_rt::test]
async fn on_a_quiet_machine_two_session_servers_are_as_fair_as_their_messages_are_fast() {
    const CLIENTS: usize = 80;
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let lab: &[&str] = &["lab"];
    let (first, second) = (
        server(&forge, &webots, lab).start().await,
        server(&forge, &webots, lab).start().await,
    );
    let both = [first.address(), second.address()];
    let sessions = [fleet(&both).start().await, fleet(&both).start().await];
    for session in &sessions {
        until_states(session, &["up"; 2]).await;
    }
    let class = Class::default();
    let clients = (0..CLIENTS).map(|number| {
        // Three of four wait at the first one.
        let session = &sessions[usize::from(number % 4 == 0)];
        let visitor = Visitor {
            class: &class,
            session: session.websocket("/session"),
            owner: "lab",
            ticket: String::new(),
            had_turn: false,
            stay: Duration::from_millis(300 + 10 * (number as u64 * 37 % 50)),
            reloads: false,
        };
        async move {
            actix_rt::time::sleep(Duration::from_millis(10 * number as u64)).await;
            visitor.visit().await;
        }
    });
    futures_util::future::join_all(clients).await;
    assert_eq!(class.served.get(), CLIENTS);
    let takes: BTreeMap<String, &[&str]> = both.iter().map(|address| (format!("ws://{address}"), lab)).collect();
    let all = class.overtakings(&takes, SEEN);
    let mut by: BTreeMap<(u64, u64), usize> = BTreeMap::new();
    for (overtaken, _) in &all {
        *by.entry(overtaken.place).or_default() += 1;
    }
    let later = |(first, second): &(Wait, Wait)| second.place.0 - first.place.0;
    println!(
        "{} overtakings, at most {} of one client, by clients that came at most {} ms later",
        all.len(),
        by.values().max().copied().unwrap_or_default(),
        all.iter().map(later).max().unwrap_or_default()
    );
    // The messages of both are on their way for some time.
    let unfair: Vec<_> = all
        .iter()
        .filter(|pair| u128::from(later(pair)) > SEEN.as_millis())
        .collect();
    assert!(unfair.is_empty(), "{unfair:#?}");
}

/// `LINE_STAYS=10` makes the stays ten times as long, 5 to 15 seconds.
#[actix_rt::test]
async fn on_a_quiet_machine_two_hundred_share_twenty_slots_in_order_whatever_happens() {
    const CLIENTS: usize = 200;
    let times: u32 = std::env::var("LINE_STAYS").map_or(1, |times| times.parse().unwrap());
    let forge = Forge::with_arm();
    let webots = Webots::launcher();
    forge.commit("school/arm", "main", &[("worlds/a.wbt", WORLD)]);
    let both: &[&str] = &["lab", "school"];
    let lab: &[&str] = &["lab"];
    let mut killed = server(&forge, &webots, both).start().await;
    let drained = server(&forge, &webots, lab).start().await;
    let third = server(&forge, &webots, both).start().await;
    let fourth = server(&forge, &webots, lab).start().await;
    let addresses = [&killed, &drained, &third, &fourth].map(Server::address);
    let mut session = fleet(&addresses).start().await;
    until_states(&session, &["up"; 4]).await;
    let class = Class::default();
    let url = session.websocket("/session");
    let clients = (0..CLIENTS).map(|number| {
        let visitor = Visitor {
            class: &class,
            session: url.clone(),
            owner: if number % 3 == 0 { "school" } else { "lab" },
            ticket: String::new(),
            had_turn: false,
            stay: times * Duration::from_millis(500 + 10 * (number as u64 * 37 % 100)),
            reloads: number % 10 == 5,
        };
        async move {
            actix_rt::time::sleep(Duration::from_millis(5 * number as u64)).await;
            visitor.visit().await;
        }
    });
    let served = async |count: usize| {
        let begun = Instant::now();
        while class.served.get() < count {
            assert!(
                begun.elapsed() < times * Duration::from_secs(120),
                "{} are served",
                class.served.get()
            );
            actix_rt::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let mut takes: BTreeMap<String, &[&str]> = BTreeMap::new();
    for (server, owners) in [(&killed, both), (&drained, lab), (&third, both), (&fourth, lab)] {
        takes.insert(format!("ws://{}", server.address()), owners);
    }
    let events = async {
        served(CLIENTS / 5).await;
        killed.signal(Signal::SIGKILL);
        killed.ended().await;
        served(CLIENTS * 2 / 5).await;
        drained.signal(Signal::SIGUSR1);
        let added = server(&forge, &webots, both).start().await;
        takes.insert(format!("ws://{}", added.address()), both);
        let addresses = [&drained, &third, &fourth, &added].map(|server| server.address());
        session.reload(json!({"simulationServers": addresses}));
        served(CLIENTS * 3 / 5).await;
        session.signal(Signal::SIGKILL);
        session.ended().await;
        let addresses = [&third, &fourth, &added].map(Server::address);
        let again = fleet(&addresses).port(session.port).start().await;
        served(CLIENTS).await;
        (added, again)
    };
    let (_, (added, again)) = tokio::join!(futures_util::future::join_all(clients), events);
    assert_eq!(class.served.get(), CLIENTS);
    let overtakings = class.overtakings(&takes, SEEN);
    let mut idle = Vec::new();
    for (server, owners) in [
        (&killed, both),
        (&drained, lab),
        (&third, both),
        (&fourth, lab),
        (&added, both),
    ] {
        idle.extend(class.idle(server, owners));
    }
    idle.sort();
    let at = |share: usize| idle[(idle.len() - 1) * share / 100];
    println!(
        "{} turns, {} lost with their server, {} overtakings; {} slots were free while somebody waited: median {:?}, 95 % {:?}, \
         longest {:?}",
        class.waits.borrow().iter().filter(|wait| wait.server.is_some()).count(),
        class.lost_turns.get(),
        overtakings.len(),
        idle.len(),
        at(50),
        at(95),
        at(100),
    );
    assert!(overtakings.is_empty(), "{overtakings:#?}");
    assert!(
        idle.len() > CLIENTS / 2 && at(100) < Duration::from_millis(200),
        "{idle:?}"
    );
    until("nobody waits any more", async || {
        again.status().await["line"]["waiting"] == 0
    })
    .await;
    assert_eq!(again.status().await["line"]["waiting"], 0);
}
