//! Passes: slots that are reserved for clients of the line of a session server.

use std::time::Duration;

use serde_json::{Value, json};
use webots_fleet::shared::domain::{
    FleetKey, Hello, Offers, Pass, PassedOver, ProjectUrl, ReservationId, ServerRun, Wish, Wishes,
};

use super::readings::gpu_driver;
use crate::support::program::{Builder, Server};
use crate::support::{Client, SOON, Webots, arm, arm_at, demo_server, make_program, until, world};

const SECRET: &str = "a secret of this test";

/// A server with two slots that reserves them.
fn reserving() -> Builder {
    demo_server(2).set("fleetKey", SECRET).set("waitingLine", 4)
}

/// What a session server does.
struct Link {
    socket: Client,
    hello: Hello,
    number: u64,
}

impl Link {
    async fn open(server: &Server) -> Self {
        let (mut socket, hello) = Self::challenged(server).await;
        let proof = hello.prove(&FleetKey::new(SECRET));
        socket.send(&serde_json::to_string(&proof).unwrap()).await;
        let mut link = Self {
            socket,
            hello,
            number: 0,
        };
        assert_eq!(link.offers().await.offers, []);
        link
    }

    async fn challenged(server: &Server) -> (Client, Hello) {
        let mut socket = Client::connect(&server.websocket("/slots")).await;
        let hello = socket.until("{").await;
        (socket, serde_json::from_str(&hello).unwrap())
    }

    async fn offers(&mut self) -> Offers {
        serde_json::from_str(&self.socket.until("{").await).unwrap()
    }

    /// The next offers that are not only an answer.
    async fn slots(&mut self) -> Vec<(u64, ReservationId)> {
        loop {
            let offers = self.offers().await.offers;
            if !offers.is_empty() {
                return offers.iter().map(|offer| (offer.ticket, offer.reservation)).collect();
            }
        }
    }

    /// Wants slots for these tickets, each of which has waited for these milliseconds.
    async fn want(&mut self, tickets: &[(u64, u64)]) {
        self.number += 1;
        let wish = |&(ticket, waited): &(u64, u64)| Wish {
            ticket,
            waited,
            address: None,
            user: None,
            world: None,
        };
        let wishes = Wishes {
            number: self.number,
            first: tickets.iter().map(wish).collect(),
            all: u32::try_from(tickets.len()).unwrap(),
            back: Vec::new(),
        };
        self.socket.send(&serde_json::to_string(&wishes).unwrap()).await;
    }

    fn pass(&self, reservation: ReservationId) -> String {
        self.pass_for(&arm(), reservation)
    }

    fn pass_for(&self, world: &str, reservation: ReservationId) -> String {
        let pass = Pass {
            server: self.hello.server,
            reservation,
        };
        pass.write(&FleetKey::new(SECRET), &ProjectUrl::parse(world).unwrap())
    }
}

async fn start(server: &Server, world: &str, pass: &str) -> Client {
    let mut client = Client::connect(&server.websocket("/client")).await;
    client
        .send(&json!({"start": {"url": world, "pass": pass}}).to_string())
        .await;
    client
}

/// The code of the reason for which a start is refused.
async fn refused(server: &Server, world: &str, pass: &str) -> String {
    let mut client = start(server, world, pass).await;
    // A simulation that runs would send other texts without an end.
    let reason = client.within("reason: ", SOON).await;
    let reason: Value = serde_json::from_str(reason.trim_start_matches("reason: ")).unwrap();
    client.until("loading: Error: ").await;
    assert_eq!(client.closed().await, Some(1000));
    reason["code"].as_str().unwrap().to_owned()
}

#[actix_rt::test]
async fn a_pass_is_for_one_client_one_world_and_one_server() {
    let server = reserving().start().await;
    let other = reserving().start().await;
    let mut link = Link::open(&server).await;
    link.want(&[(1, 0), (2, 0)]).await;
    let slots = link.slots().await;
    assert_eq!(slots.iter().map(|(ticket, _)| *ticket).collect::<Vec<_>>(), [1, 2]);
    assert_eq!(server.status().await["instances"]["reserved"], 2);
    // All slots are promised: nobody else gets one.
    let mut without = Client::start(&server, &arm()).await;
    assert_eq!(without.until("queue: ").await, "queue: 0");
    without.until("loading: waiting for a place").await;
    let pass = link.pass(slots[0].1);
    let foreign = Pass {
        server: link.hello.server,
        reservation: slots[0].1,
    };
    let world = ProjectUrl::parse(&arm()).unwrap();
    for forged in [
        foreign.write(&FleetKey::new("another secret key"), &world),
        pass.chars().rev().collect(),
        String::new(),
        Pass {
            server: ServerRun(1),
            ..foreign
        }
        .write(&FleetKey::new(SECRET), &world),
    ] {
        assert_eq!(refused(&server, &arm(), &forged).await, "invalid-pass", "{forged}");
    }
    assert_eq!(
        refused(&server, &arm_at("worlds/other.wbt"), &pass).await,
        "invalid-pass"
    );
    assert_eq!(refused(&other, &arm(), &pass).await, "invalid-pass");
    // Nobody was disturbed by that: both have their slots.
    let mut first = start(&server, &arm(), &pass).await;
    first.until("webots:").await;
    assert_eq!(refused(&server, &arm(), &pass).await, "used-pass");
    let mut second = start(&server, &arm(), &link.pass(slots[1].1)).await;
    second.until("webots:").await;
    assert!(without.is_silent(Duration::from_millis(50)).await);
    first.leave().await;
    without.until("webots:").await;
}

#[actix_rt::test]
async fn a_reservation_that_is_not_used_in_time_goes_to_the_next() {
    let server = reserving().set("timing.pass", 0.5).start().await;
    let mut link = Link::open(&server).await;
    link.want(&[(1, 9), (2, 8), (3, 7)]).await;
    let slots = link.slots().await;
    assert_eq!(slots.len(), 2);
    let next = link.slots().await;
    assert_eq!(next[0].0, 3);
    assert_eq!(refused(&server, &arm(), &link.pass(slots[0].1)).await, "expired-pass");
    start(&server, &arm(), &link.pass(next[0].1))
        .await
        .until("webots:")
        .await;
}

#[actix_rt::test]
async fn the_order_of_arrival_holds_for_its_own_queue_and_all_session_servers() {
    let server = reserving().start().await;
    let mut one = Client::ready(&server).await;
    let mut two = Client::ready(&server).await;
    let mut link = Link::open(&server).await;
    let mut other = Link::open(&server).await;
    let mut own = Client::start(&server, &arm()).await;
    assert_eq!(own.until("queue: ").await, "queue: 0");
    // The first of each line came before it, the second of the other one later.
    link.want(&[(1, 60_000)]).await;
    assert_eq!(own.until("queue: ").await, "queue: 1");
    other.want(&[(2, 90_000), (3, 0)]).await;
    assert_eq!(own.until("queue: ").await, "queue: 2");
    one.send("").await;
    one.leave().await;
    assert_eq!(other.slots().await[0].0, 2);
    assert_eq!(own.until("queue: ").await, "queue: 1");
    two.send("").await;
    two.leave().await;
    let slots = link.slots().await;
    assert_eq!(slots[0].0, 1);
    assert_eq!(own.until("queue: ").await, "queue: 0");
    // Its client comes, and leaves: now it is the turn of the own client.
    let mut first = start(&server, &arm(), &link.pass(slots[0].1)).await;
    first.until("webots:").await;
    first.leave().await;
    own.until("webots:").await;
    // A session server that is gone wants nothing any more, but what it was promised stays.
    other.socket.leave().await;
    until("its reservation stays", async || {
        server.status().await["instances"]["reserved"] == 1
    })
    .await;
}

#[actix_rt::test]
async fn the_order_of_a_session_server_holds_whatever_its_messages_round() {
    let server = reserving().start().await;
    let inside = [Client::ready(&server).await, Client::ready(&server).await];
    let mut link = Link::open(&server).await;
    // Both came in one millisecond, but one was told of before, by a message that was faster.
    link.want(&[(2, 500)]).await;
    link.offers().await;
    link.want(&[(1, 400), (2, 400)]).await;
    link.offers().await;
    let [first, second] = inside;
    first.leave().await;
    assert_eq!(link.slots().await[0].0, 1);
    second.leave().await;
    assert_eq!(link.slots().await[0].0, 2);
}

#[actix_rt::test]
async fn only_a_server_with_the_key_gets_slots() {
    let server = reserving().set("maxClientsPerAddress", 1).start().await;
    let (mut socket, hello) = Link::challenged(&server).await;
    let proof = hello.prove(&FleetKey::new("another secret key"));
    socket.send(&serde_json::to_string(&proof).unwrap()).await;
    assert_eq!(socket.closed().await, Some(1008));
    // The answer to one challenge is none to another.
    let (mut socket, other) = Link::challenged(&server).await;
    assert_ne!(hello, other);
    let replayed = hello.prove(&FleetKey::new(SECRET));
    socket.send(&serde_json::to_string(&replayed).unwrap()).await;
    assert_eq!(socket.closed().await, Some(1008));
    let (mut socket, _) = Link::challenged(&server).await;
    socket.send(r#"{"number": 1, "first": [], "all": 0}"#).await;
    assert_eq!(socket.closed().await, Some(1008));
    // Who has not proved anything sends no long messages, and is not waited for.
    let (mut socket, _) = Link::challenged(&server).await;
    socket.send(&"x".repeat(9 * 1024)).await;
    assert_eq!(socket.closed().await, Some(1008));
    let (mut socket, _) = Link::challenged(&server).await;
    assert_eq!(socket.closed().await, Some(1008));
    // Pages that listen take no link from it.
    let from = ("x-forwarded-for", "203.0.113.9");
    let page = awc::Client::default().get(server.url("/events")).insert_header(from);
    let _page = page.send().await.unwrap();
    let mut link = Client::with_headers(&server.websocket("/slots"), &[from])
        .await
        .unwrap();
    link.until("{").await;
    let plain = demo_server(1).start().await;
    assert_eq!(
        Client::with_headers(&plain.websocket("/slots"), &[]).await.unwrap_err(),
        404
    );
}

#[actix_rt::test]
async fn a_draining_server_keeps_its_promises_and_makes_no_others() {
    let mut server = reserving().start().await;
    let inside = Client::ready(&server).await;
    let mut link = Link::open(&server).await;
    link.want(&[(1, 0), (2, 0)]).await;
    let slots = link.slots().await;
    server.signal(nix::sys::signal::Signal::SIGUSR1);
    until("it drains", async || server.status().await["draining"] == true).await;
    inside.leave().await;
    let mut client = start(&server, &arm(), &link.pass(slots[0].1)).await;
    client.until("webots:").await;
    link.want(&[(2, 0)]).await;
    assert_eq!(link.offers().await.offers, []);
    client.leave().await;
    assert_eq!(server.ended().await, Some(0));
}

#[actix_rt::test]
async fn a_slot_that_was_reserved_is_given_although_the_load_has_risen() {
    needs!("cc");
    // All commands of this Docker succeed: the client's start has only to begin.
    let programs = tempfile::tempdir().unwrap();
    make_program(&programs.path().join("docker"), "exit 0");
    let path = format!("{}:{}", programs.path().display(), std::env::var("PATH").unwrap());
    let library = gpu_driver();
    let busy = library.path().join("busy");
    let server = reserving()
        .set("docker", true)
        .set("shareIdleTime", 100)
        .env("PATH", &path)
        .env("LD_LIBRARY_PATH", library.path().to_str().unwrap())
        .env("NVML_BUSY", busy.to_str().unwrap())
        .start()
        .await;
    let other = world("other/world", "main", "worlds/a.wbt");
    let mut link = Link::open(&server).await;
    link.want(&[(1, 0)]).await;
    let slots = link.slots().await;
    std::fs::write(&busy, "").unwrap();
    until("the load is high", async || {
        server.status().await["load"].as_f64() > Some(100.0)
    })
    .await;
    let mut without = Client::start(&server, &other).await;
    without.until("loading: Error: ").await;
    assert_eq!(without.reason()["code"], "no-idle-time");
    let mut client = start(&server, &other, &link.pass_for(&other, slots[0].1)).await;
    client.until("session: ").await;
}

#[actix_rt::test]
async fn who_comes_during_a_fault_gets_a_slot_after_it() {
    let webots = Webots::launcher();
    let server = reserving()
        .set("maxConnections", 1)
        .set("webots", webots.path().to_str());
    let server = server.start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("webots:").await;
    let away = webots.path().with_file_name("away");
    std::fs::rename(webots.path(), &away).unwrap();
    until("it is not ready", async || server.health().await.0 == 503).await;
    let mut link = Link::open(&server).await;
    link.want(&[(1, 0)]).await;
    assert_eq!(link.offers().await.offers, []);
    std::fs::rename(&away, webots.path()).unwrap();
    until("it is ready", async || server.health().await.0 == 200).await;
    client.leave().await;
    assert_eq!(link.slots().await[0].0, 1);
}

#[actix_rt::test]
async fn who_has_its_share_is_passed_over_and_keeps_its_place() {
    let server = reserving()
        .set("maxPlacesPerAddress", 1)
        .set("userHeader", "X-User")
        .start()
        .await;
    let mut greedy = Client::start_from(&server, "203.0.113.9", &arm()).await;
    greedy.until("webots:").await;
    let mut link = Link::open(&server).await;
    let wish = |ticket: u64, waited: u64, address: &str| Wish {
        ticket,
        waited,
        address: Some(address.parse().unwrap()),
        user: None,
        world: None,
    };
    let wishes = Wishes {
        number: 1,
        first: vec![wish(1, 90, "203.0.113.9"), wish(2, 80, "203.0.113.10")],
        all: 2,
        back: Vec::new(),
    };
    link.socket.send(&serde_json::to_string(&wishes).unwrap()).await;
    let offers = link.offers().await;
    assert_eq!(offers.offers[0].ticket, 2);
    // So the session server can name others instead.
    assert_eq!(offers.passed, [PassedOver::Address("203.0.113.9".parse().unwrap())]);
    greedy.leave().await;
    let offers = link.offers().await;
    assert_eq!((offers.offers[0].ticket, offers.passed), (1, Vec::new()));
}

#[actix_rt::test]
async fn an_address_that_lets_slots_expire_comes_after_the_others() {
    let server = reserving()
        .set("maxConnections", 1)
        .set("timing.pass", 0.05)
        .start()
        .await;
    let mut link = Link::open(&server).await;
    let (wasteful, other) = ("203.0.113.9", "203.0.113.10");
    let wish = |ticket: u64, waited: u64, address: &str| Wish {
        ticket,
        waited,
        address: Some(address.parse().unwrap()),
        user: None,
        world: None,
    };
    // All its clients have waited longer, and none of them comes.
    let mut first: Vec<Wish> = (0..30).map(|ticket| wish(ticket, 90_000 - ticket, wasteful)).collect();
    first.push(wish(99, 1, other));
    let wishes = Wishes {
        number: 1,
        all: 31,
        first,
        back: Vec::new(),
    };
    link.socket.send(&serde_json::to_string(&wishes).unwrap()).await;
    let mut served = Vec::new();
    while served.last() != Some(&99) {
        served.extend(link.slots().await.into_iter().map(|(ticket, _)| ticket));
    }
    // Twenty expire without a consequence, and one tells that it is too many.
    assert_eq!(served, (0..21).chain([99]).collect::<Vec<_>>());
}

#[actix_rt::test]
async fn a_session_server_that_sends_nonsense_disturbs_no_other() {
    let server = reserving().start().await;
    let (mut bad, mut good) = (Link::open(&server).await, Link::open(&server).await);
    bad.want(&[(7, 99)]).await;
    assert_eq!(bad.slots().await[0].0, 7);
    // It gives back what it was not given.
    let wishes = Wishes {
        number: 2,
        back: (0..100).map(ReservationId).collect(),
        ..Wishes::default()
    };
    bad.socket.send(&serde_json::to_string(&wishes).unwrap()).await;
    good.want(&[(8, 1)]).await;
    let slots = good.slots().await;
    assert_eq!(slots[0].0, 8);
    assert_eq!(server.status().await["instances"]["reserved"], 2);
    bad.socket.send(&"x".repeat(9 * 1024)).await;
    assert_eq!(bad.socket.closed().await, Some(1008));
    for text in ["[]", r#"{"number": 1}"#, r#"{"number": -1, "first": [], "all": 0}"#] {
        let mut bad = Link::open(&server).await;
        bad.socket.send(text).await;
        assert_eq!(bad.socket.closed().await, Some(1008), "{text}");
    }
    let mut client = start(&server, &arm(), &good.pass(slots[0].1)).await;
    client.until("webots:").await;
}

#[actix_rt::test]
async fn a_pass_is_valid_over_an_upgrade() {
    let server = reserving().start().await;
    let mut link = Link::open(&server).await;
    link.want(&[(1, 0)]).await;
    let slots = link.slots().await;
    let pass = link.pass(slots[0].1);
    let (succeeds, told) = server.upgrade().await;
    assert!(succeeds, "{told}");
    // The session server connects again, to the new process.
    assert_eq!(link.socket.closed().await, Some(1001));
    let mut next = Link::open(&server).await;
    assert_ne!(next.hello.server, link.hello.server);
    // The promised slot is no other's.
    next.want(&[(2, 0), (3, 0)]).await;
    let others = next.slots().await;
    assert_eq!(others.iter().map(|(ticket, _)| *ticket).collect::<Vec<_>>(), [2]);
    let mut client = start(&server, &arm(), &pass).await;
    client.until("webots:").await;
    let mut other = start(&server, &arm(), &next.pass(others[0].1)).await;
    other.until("webots:").await;
    assert_eq!(server.status().await["instances"]["places"], 2);
    // The slot of the older process is given to the line of the new one.
    client.close_with(1000).await;
    assert_eq!(next.slots().await[0].0, 3);
}
