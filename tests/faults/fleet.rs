//! The fleet that is tested, and what must hold of it.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use procfs::net::TcpState;
use procfs::process::Process;
use serde_json::json;

use crate::class::Class;
use crate::machine::Clock;
use crate::network::Network;
use crate::support::client::Heard;
use crate::support::name_server::NameServer;
use crate::support::relay::Relay;
use crate::support::{
    Builder, Client, Forge, SOON, Server, Webots, arm, disk, http, instance_folders_in, instances_below, ports,
    session_server, simulation_server,
};

/// How many simulation servers there are.
pub const SERVERS: usize = 5;
/// The one on a small disk of its own.
pub const SMALL_DISK: usize = 3;
/// The one behind a link that can be cut.
pub const LINKED: usize = 4;
/// The one that a name leads to.
const NAMED: usize = 0;
/// That name.
const NAME: &str = "fleet.test";
/// How many simulations fit on each.
pub const PLACES: u16 = 4;
/// How long the fleet may take to be whole again, on a machine that has much else to do.
pub const BOUND: Duration = Duration::from_mins(1);

/// A session server and its simulation servers.
pub struct Fleet {
    pub session: Server,
    pub servers: Vec<Server>,
    pub relay: Relay,
    /// Where there can be one.
    pub names: Option<NameServer>,
    /// That of all servers.
    pub clock: Clock,
    /// Where packets can be lost.
    pub network: Option<Network>,
    forge: Forge,
    webots: Webots,
    folder: tempfile::TempDir,
    session_port: u16,
    ports: Vec<u16>,
    began: Instant,
    /// How often all that must hold was found to hold.
    pub checks: u32,
    /// What each server took of memory before anything happened, in bytes.
    memory: Vec<u64>,
}

impl Fleet {
    pub async fn start(network: Option<Network>) -> Self {
        let (names, clock) = (NameServer::start("a server by a name, and faults of names"), Clock::new());
        let (forge, webots) = (Forge::with_arm(), Webots::launcher());
        let folder = tempfile::tempdir().unwrap();
        let ports: Vec<u16> = (0..SERVERS).map(|_| ports::block(PLACES + 12)).collect();
        disk::small_disk(&folder.path().join(format!("server-{SMALL_DISK}")), 64);
        let mut servers = Vec::new();
        for (index, port) in ports.iter().enumerate() {
            let name = folder.path().join(format!("server-{index}"));
            std::fs::create_dir_all(&name).unwrap();
            servers.push(configure(&forge, &webots, &clock).folder(&name).port(*port).start().await);
        }
        let relay = Relay::to(ports[LINKED]).await;
        let session_port = ports::block(1);
        let session = session_builder(&ports, &relay, names.as_ref(), session_port, folder.path());
        let session = clock.of(session).start().await;
        let memory = servers.iter().map(|server| memory(server.pid())).collect();
        let began = Instant::now();
        let fleet = Self {
            session,
            servers,
            relay,
            names,
            clock,
            network,
            forge,
            webots,
            folder,
            session_port,
            ports,
            began,
            checks: 0,
            memory,
        };
        fleet.set_name();
        fleet
    }

    /// Has the name server know the name.
    pub fn set_name(&self) {
        if let Some(names) = &self.names {
            names.set(NAME, &[std::net::Ipv4Addr::LOCALHOST.into()]);
        }
    }

    /// Where the files of all servers are.
    pub fn root(&self) -> &Path {
        self.folder.path()
    }

    /// Where a server's files are.
    pub fn folder(&self, index: usize) -> PathBuf {
        self.folder.path().join(format!("server-{index}"))
    }

    /// A streaming port of a server.
    pub fn port(&self, index: usize, place: u16) -> u16 {
        self.ports[index] + 1 + place % PLACES
    }

    /// All ports of a server, as `FIRST:LAST`.
    pub fn ports_of(&self, index: usize) -> String {
        format!("{}:{}", self.ports[index], self.ports[index] + PLACES)
    }

    /// A simulation server at the place of another.
    pub fn configured(&self, index: usize) -> Builder {
        let builder = configure(&self.forge, &self.webots, &self.clock);
        builder.folder(&self.folder(index)).port(self.ports[index])
    }

    /// Starts a simulation server at the place of one that is gone, as a service manager does.
    pub async fn restart(&mut self, index: usize) {
        self.servers[index] = self.configured(index).start().await;
    }

    /// Starts a session server at the place of the one that is gone.
    pub async fn restart_session(&mut self) {
        let session =
            session_builder(&self.ports, &self.relay, self.names.as_ref(), self.session_port, self.folder.path());
        self.session = self.clock.of(session).start().await;
    }

    /// Lets a class come again and again for so long.
    pub fn class(&self, time: Duration) -> Class {
        Class::start(&format!("http://127.0.0.1:{}", self.session_port), self.folder.path(), time)
    }

    /// Waits until everything holds that must hold. Returns when that was so.
    pub async fn whole(&mut self, after: &str) -> Instant {
        let deadline = Instant::now() + BOUND;
        loop {
            let Err(why) = self.look().await else { break };
            assert!(Instant::now() < deadline, "{} s after {after}: {why}", BOUND.as_secs());
            actix_rt::time::sleep(Duration::from_millis(50)).await;
        }
        self.checks += 1;
        Instant::now()
    }

    /// One look at everything that must hold while clients come and go.
    async fn look(&self) -> Result<(), String> {
        let status = http::try_get(&self.session.url("/status")).await?.json();
        let states: Vec<&str> =
            status["servers"].as_array().unwrap().iter().map(|s| s["state"].as_str().unwrap()).collect();
        if states.len() != SERVERS || states.iter().any(|state| !matches!(*state, "up" | "full")) {
            return Err(format!("the servers are {states:?}: {status}"));
        }
        // What clients are told is what is true.
        let mut client = Client::try_connect(&self.session.websocket("/")).await?;
        let Some(Heard::Text(told)) = client.next_within(SOON).await else {
            return Err("availability is not told".to_owned());
        };
        let is_true = states.contains(&"up");
        if (told == "1") != is_true {
            return Err(format!("clients are told {told}, the servers are {states:?}"));
        }
        // Simulations are those of clients that are there, and nothing else is left of others.
        for (index, server) in self.servers.iter().enumerate() {
            let known = http::try_get(&server.url("/status")).await?.json();
            let known = known["simulations"].as_array().unwrap().len();
            let folders = self.instance_folders(index);
            if folders > known {
                return Err(format!("server {index} knows {known} simulations and has {folders} folders"));
            }
            let places = self.port(index, 0)..=self.port(index, PLACES - 1);
            let taken = listening().filter(|port| places.contains(port)).count();
            if taken > known {
                return Err(format!("server {index} knows {known} simulations, and {taken} of its ports are taken"));
            }
        }
        // A client of its own gets a simulation.
        let given = http::try_get(&self.session.url("/session")).await?.text();
        try_start(&given).await?.leave().await;
        Ok(())
    }

    fn instance_folders(&self, index: usize) -> usize {
        instance_folders_in(&self.folder(index).join("cache")).len()
    }

    /// Waits until nothing is left of any simulation: no process, port or folder, and memory as it was.
    pub async fn empty(&mut self) {
        let deadline = Instant::now() + BOUND;
        while let Err(why) = self.look_for_rests() {
            assert!(Instant::now() < deadline, "{} s after the class: {why}", BOUND.as_secs());
            actix_rt::time::sleep(Duration::from_millis(50)).await;
        }
        self.checks += 1;
    }

    fn look_for_rests(&self) -> Result<(), String> {
        for (index, server) in self.servers.iter().enumerate() {
            let processes = instances_below(&self.folder(index));
            if !processes.is_empty() {
                return Err(format!("server {index} has left {processes:?}"));
            }
            if self.instance_folders(index) > 0 {
                return Err(format!("server {index} has left folders"));
            }
            let first = self.port(index, 0);
            if let Some(port) = listening().find(|port| (first..first + PLACES).contains(port)) {
                return Err(format!("server {index} has left port {port}"));
            }
            let (before, now) = (self.memory[index], memory(server.pid()));
            if now > before + (24 << 20) {
                return Err(format!("server {index} takes {} MiB, and took {}", now >> 20, before >> 20));
            }
        }
        Ok(())
    }

    /// Seconds since the start.
    pub fn age(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }
}

fn configure(forge: &Forge, webots: &Webots, clock: &Clock) -> Builder {
    let timing = json!({"grace": 1, "heartbeat": 0.5, "ping": 2, "silence": 6, "launch": 20, "checkout": 40});
    let builder = simulation_server(&webots.path(), forge.path(), PLACES).set("hangLimit", 1).set("timing", timing);
    // The small disk has less room than the default.
    clock.of(builder.set("diskReserve", 8))
}

fn session_builder(ports: &[u16], relay: &Relay, names: Option<&NameServer>, port: u16, folder: &Path) -> Builder {
    let folder = folder.join("session");
    std::fs::create_dir_all(&folder).unwrap();
    let builder =
        session_server(&addresses(ports, relay, names)).folder(&folder).port(port).set("timing", json!({"answer": 1}));
    let builder = match names {
        Some(names) => builder.before(&names.asked()),
        None => builder,
    };
    // What else runs on this machine must not close the fleet.
    builder.set("loadThreshold", 1000)
}

/// Where the session server finds each simulation server.
fn addresses(ports: &[u16], relay: &Relay, names: Option<&NameServer>) -> Vec<String> {
    let of = |(index, port)| match index {
        NAMED if names.is_some() => format!("dns+{NAME}:{port}"),
        LINKED => format!("127.0.0.1:{}", relay.port),
        _ => format!("127.0.0.1:{port}"),
    };
    ports.iter().copied().enumerate().map(of).collect()
}

/// The ports at which somebody listens. To try to take one would be in the way of a server that tries the same.
fn listening() -> impl Iterator<Item = u16> {
    let all = Process::myself().and_then(|this| this.tcp()).unwrap();
    all.into_iter().filter(|one| one.state == TcpState::Listen).map(|one| one.local_address.port())
}

/// What a process has in memory, in bytes.
fn memory(pid: i32) -> u64 {
    Process::new(pid).and_then(|process| process.statm()).unwrap().resident * procfs::page_size()
}

/// A client whose simulation runs on this server.
pub async fn try_start(server: &str) -> Result<Client, String> {
    let client = Client::try_connect(&format!("{server}/client")).await;
    let mut client = client.map_err(|why| format!("{server}: {why}"))?;
    client.try_send(&json!({"start": {"url": arm()}}).to_string()).await?;
    loop {
        match client.next_within(SOON).await {
            Some(Heard::Text(text)) if text.starts_with("webots:") => return Ok(client),
            Some(Heard::Text(text)) if !text.starts_with("loading: Error") => {}
            heard => return Err(format!("{server}: {heard:?} after {:?}", client.heard)),
        }
    }
}
