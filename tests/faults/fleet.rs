//! The fleet under test, and its invariants.

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use procfs::net::{TcpNetEntry, TcpState};
use procfs::process::Process;
use serde_json::json;

use crate::class::Class;
use crate::support::client::Heard;
use crate::support::clock::Clock;
use crate::support::name_server::NameServer;
use crate::support::network::Network;
use crate::support::relay::Relay;
use crate::support::{self, Builder, Client, Forge, SOON, Server, Webots, disk, http, ports};
use crate::support::{instance_folders_in, instances_below, session_server, simulation_server};

/// Number of simulation servers.
pub const SERVERS: usize = 5;
/// The server with a small disk of its own.
pub const SMALL_DISK: usize = 3;
/// The server behind a link that can be cut.
pub const LINKED: usize = 4;
/// The server that is found by a name.
const NAMED: usize = 0;
const NAME: &str = "fleet.test";
/// Slots of each simulation server.
pub const PLACES: u16 = 4;
/// Longest time until the fleet is whole again, on a machine with much other load.
pub const BOUND: Duration = Duration::from_mins(1);

/// What the servers need, also to restart.
pub struct Site {
    pub relay: Relay,
    /// `None` if there can't be one.
    pub names: Option<NameServer>,
    /// Shared by all servers.
    pub clock: Clock,
    forge: Forge,
    webots: Webots,
    folder: tempfile::TempDir,
    session_port: u16,
    ports: Vec<u16>,
}

impl Site {
    async fn new() -> Self {
        let ports: Vec<u16> = (0..SERVERS).map(|_| ports::block(PLACES + 12)).collect();
        let site = Self {
            relay: Relay::to(ports[LINKED]).await,
            names: NameServer::start(),
            clock: Clock::new(),
            forge: Forge::with_arm(),
            webots: Webots::launcher(),
            folder: tempfile::tempdir().unwrap(),
            session_port: ports::block(1),
            ports,
        };
        disk::small_disk(&site.folder(SMALL_DISK), 64);
        site.set_name();
        site
    }

    /// Adds the name to the name server.
    pub fn set_name(&self) {
        if let Some(names) = &self.names {
            names.set(NAME, &[std::net::Ipv4Addr::LOCALHOST.into()]);
        }
    }

    /// Directory of all servers' files.
    pub fn root(&self) -> &Path {
        self.folder.path()
    }

    /// Directory of a server's files.
    pub fn folder(&self, index: usize) -> PathBuf {
        self.folder.path().join(format!("server-{index}"))
    }

    /// The streaming ports of a server.
    fn places(&self, index: usize) -> RangeInclusive<u16> {
        self.ports[index] + 1..=self.ports[index] + PLACES
    }

    /// All ports of a server, as `FIRST:LAST`.
    pub fn ports_of(&self, index: usize) -> String {
        format!("{}:{}", self.ports[index], self.ports[index] + PLACES)
    }

    /// A simulation server.
    pub fn server(&self, index: usize) -> Builder {
        let timing = json!({
            "grace": 1, "heartbeat": 0.5, "ping": 2, "silence": 6, "launch": 20, "checkout": 40, "arrival": 0,
        });
        let builder = simulation_server(&self.webots.path(), self.forge.path(), PLACES).set("timing", timing);
        std::fs::create_dir_all(self.folder(index)).unwrap();
        // The small disk has less room than the default reserve.
        let builder = builder.set("hangLimit", 1).set("diskReserve", 8);
        self.clock
            .of(builder)
            .folder(&self.folder(index))
            .port(self.ports[index])
    }

    /// The session server.
    fn session(&self) -> Builder {
        let folder = self.folder.path().join("session");
        std::fs::create_dir_all(&folder).unwrap();
        let address = |(index, port): (usize, &u16)| match index {
            NAMED if self.names.is_some() => format!("dns+{NAME}:{port}"),
            LINKED => format!("127.0.0.1:{}", self.relay.port),
            _ => format!("127.0.0.1:{port}"),
        };
        let addresses: Vec<String> = self.ports.iter().enumerate().map(address).collect();
        let builder = session_server(&addresses).folder(&folder).port(self.session_port);
        let builder = match &self.names {
            Some(names) => builder.before(&names.asked()),
            None => builder,
        };
        // Other load on this machine must not close the fleet.
        self.clock
            .of(builder.set("timing", json!({"answer": 1})).set("loadThreshold", 1000))
    }
}

/// A session server and its simulation servers.
pub struct Fleet {
    pub session: Server,
    pub servers: Vec<Server>,
    pub site: Site,
    /// A network that can lose packets.
    pub network: Option<Network>,
    /// The memory of each server at the start, in bytes.
    memory: Vec<u64>,
}

impl Fleet {
    pub async fn start(network: Option<Network>) -> Self {
        let site = Site::new().await;
        let mut servers = Vec::new();
        for index in 0..SERVERS {
            servers.push(site.server(index).start().await);
        }
        let session = site.session().start().await;
        let memory = servers.iter().map(|server| memory(server.pid())).collect();
        Self {
            session,
            servers,
            site,
            network,
            memory,
        }
    }

    /// Restarts a simulation server that has ended, as a service manager does.
    pub async fn restart(&mut self, index: usize) {
        self.servers[index] = self.site.server(index).start().await;
    }

    /// Restarts the session server after it has ended.
    pub async fn restart_session(&mut self) {
        self.session = self.site.session().start().await;
    }

    /// Makes a class come again and again for this long.
    pub fn class(&self, time: Duration) -> Class {
        Class::start(&self.session.url(""), self.site.root(), time)
    }

    /// Waits until all invariants hold.
    pub async fn whole(&self, after: &str) {
        self.comes_to(after, Self::look).await;
    }

    /// Waits until nothing of any simulation remains, neither process, port nor folder, and memory is as before.
    pub async fn empty(&self) {
        self.comes_to("the class", async |fleet| fleet.look_for_rests()).await;
    }

    async fn comes_to(&self, after: &str, look: impl AsyncFn(&Self) -> Result<(), String>) {
        let deadline = Instant::now() + BOUND;
        while let Err(why) = look(self).await {
            assert!(Instant::now() < deadline, "{} s after {after}: {why}", BOUND.as_secs());
            actix_rt::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Checks all invariants once, while clients come and go.
    async fn look(&self) -> Result<(), String> {
        let status = http::try_get(&self.session.url("/status")).await?.json();
        let states: Vec<&str> = status["servers"]
            .as_array()
            .unwrap()
            .iter()
            .map(|s| s["state"].as_str().unwrap())
            .collect();
        if states.len() != SERVERS || states.iter().any(|state| !matches!(*state, "up" | "full")) {
            return Err(format!("the servers are {states:?}: {status}"));
        }
        // Clients receive the true availability.
        let mut client = Client::try_connect(&self.session.websocket("/")).await?;
        let Some(Heard::Text(told)) = client.next_within(SOON).await else {
            return Err("availability is not told".to_owned());
        };
        let is_true = states.contains(&"up");
        if (told == "1") != is_true {
            return Err(format!("clients are told {told}, the servers are {states:?}"));
        }
        // Each simulation has a client, and nothing of others remains.
        for (index, server) in self.servers.iter().enumerate() {
            let known = http::try_get(&server.url("/status")).await?.json();
            let known = known["simulations"].as_array().unwrap().len();
            let (folders, ports) = self.held(index);
            if folders.max(ports) > known {
                return Err(format!(
                    "server {index} knows {known} simulations, has {folders} folders and {ports} ports"
                ));
            }
        }
        // A new client gets a simulation.
        let given = http::try_get(&self.session.url("/session")).await?.text();
        try_start(&given).await?.leave().await;
        Ok(())
    }

    /// The number of instance directories and of streaming ports in use on a server. Does not try to bind the ports,
    /// which could make a server fail that tries the same.
    fn held(&self, index: usize) -> (usize, usize) {
        let all = Process::myself().and_then(|this| this.tcp()).unwrap();
        let places = self.site.places(index);
        let is_held = |one: &&TcpNetEntry| one.state == TcpState::Listen && places.contains(&one.local_address.port());
        (
            instance_folders_in(&self.site.folder(index).join("cache")).len(),
            all.iter().filter(is_held).count(),
        )
    }

    fn look_for_rests(&self) -> Result<(), String> {
        for (index, server) in self.servers.iter().enumerate() {
            let processes = instances_below(&self.site.folder(index));
            let held = self.held(index);
            if !processes.is_empty() || held != (0, 0) {
                return Err(format!(
                    "server {index} has left {processes:?}, and folders and ports: {held:?}"
                ));
            }
            let before = self.memory[index];
            let now = memory(server.pid());
            if now > before + (24 << 20) {
                return Err(format!(
                    "server {index} takes {} MiB, and took {}",
                    now >> 20,
                    before >> 20
                ));
            }
        }
        Ok(())
    }
}

/// The resident memory of a process, in bytes.
fn memory(pid: i32) -> u64 {
    Process::new(pid).and_then(|process| process.statm()).unwrap().resident * procfs::page_size()
}

/// A client whose simulation runs on this server.
pub async fn try_start(server: &str) -> Result<Client, String> {
    let client = Client::try_connect(&format!("{server}/client")).await;
    let mut client = client.map_err(|why| format!("{server}: {why}"))?;
    client
        .try_send(&json!({"start": {"url": support::arm()}}).to_string())
        .await?;
    loop {
        match client.next_within(SOON).await {
            Some(Heard::Text(text)) if text.starts_with("webots:") => return Ok(client),
            Some(Heard::Text(text)) if !text.starts_with("loading: Error") => {}
            heard => return Err(format!("{server}: {heard:?} after {:?}", client.heard)),
        }
    }
}
