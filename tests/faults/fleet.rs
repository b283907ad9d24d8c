//! The fleet that is tested, and what must hold of it.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::disk;
use crate::relay::Relay;
use crate::support::client::{Client, Heard};
use crate::support::git::{Forge, world};
use crate::support::program::{Builder, Server, session_server, simulation_server};
use crate::support::webots::{Webots, instances_below};
use crate::support::{http, ports};

/// How many simulation servers there are.
pub const SERVERS: usize = 5;
/// The one on a small disk of its own.
pub const SMALL_DISK: usize = 3;
/// The one behind a link that can be cut.
pub const LINKED: usize = 4;
/// How many simulations fit on each.
const PLACES: u16 = 4;
/// How many clients come and go.
const CLIENTS: u32 = 8;
/// How long the fleet may take to be whole again.
const BOUND: Duration = Duration::from_secs(30);

/// A session server and its simulation servers.
pub struct Fleet {
    pub session: Server,
    pub servers: Vec<Server>,
    pub relay: Relay,
    forge: Forge,
    webots: Webots,
    folder: tempfile::TempDir,
    session_port: u16,
    ports: Vec<u16>,
    began: Instant,
    checks: u32,
    /// What each server took of memory before anything happened, in bytes.
    memory: Vec<u64>,
}

/// A class that comes and goes: a rehearsal.
pub struct Class {
    child: Child,
    file: PathBuf,
}

impl Fleet {
    pub async fn start() -> Self {
        let (forge, webots) = (Forge::with_arm(), Webots::launcher());
        let folder = tempfile::tempdir().unwrap();
        let ports: Vec<u16> = (0..SERVERS).map(|_| ports::block(PLACES + 12)).collect();
        disk::small_disk(&folder.path().join(format!("server-{SMALL_DISK}")));
        let mut servers = Vec::new();
        for (index, port) in ports.iter().enumerate() {
            let name = folder.path().join(format!("server-{index}"));
            std::fs::create_dir_all(&name).unwrap();
            servers.push(configure(&forge, &webots).folder(&name).port(*port).start().await);
        }
        let relay = Relay::to(ports[LINKED]).await;
        let session_port = ports::block(1);
        let addresses = addresses(&ports, &relay);
        let session = session_builder(&addresses, session_port, folder.path()).start().await;
        let memory = servers.iter().map(|server| memory(server.pid())).collect();
        let began = Instant::now();
        Self { session, servers, relay, forge, webots, folder, session_port, ports, began, checks: 0, memory }
    }

    /// Where a server's files are.
    pub fn folder(&self, index: usize) -> PathBuf {
        self.folder.path().join(format!("server-{index}"))
    }

    /// A streaming port of a server.
    pub fn port(&self, index: usize, place: u16) -> u16 {
        self.ports[index] + 1 + place % PLACES
    }

    /// Starts a simulation server at the place of one that is gone, as a service manager does.
    pub async fn restart(&mut self, index: usize) {
        let builder = configure(&self.forge, &self.webots).folder(&self.folder(index)).port(self.ports[index]);
        self.servers[index] = builder.start().await;
    }

    /// Starts a session server at the place of the one that is gone.
    pub async fn restart_session(&mut self) {
        let addresses = addresses(&self.ports, &self.relay);
        self.session = session_builder(&addresses, self.session_port, self.folder.path()).start().await;
    }

    /// Lets a class come again and again for so long.
    pub fn class(&self, time: Duration) -> Class {
        let file = self.folder.path().join("class.json");
        let url = format!("http://127.0.0.1:{}", self.session_port);
        let mut command = Command::new(env!("CARGO_BIN_EXE_rehearse"));
        command.args([&url, "--world", &world("lab/arm", "main", "worlds/a.wbt"), "--over", "1s", "--stay", "3s"]);
        command.args(["--patience", "20s", "--misbehave", "reload=10,drop=10,sleep=5,vanish=5,hasty=15"]);
        command.args(["--clients", &CLIENTS.to_string(), "--soak", &format!("{}s", time.as_secs())]);
        let child = command.arg("--json").arg(&file).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        Class { child, file }
    }

    /// Waits until everything holds that must hold. Returns when that was so.
    pub async fn whole(&mut self, after: &str) -> Instant {
        let deadline = Instant::now() + BOUND;
        loop {
            match self.look().await {
                Ok(()) => {
                    self.checks += 1;
                    return Instant::now();
                }
                Err(why) if Instant::now() > deadline => panic!("{} s after {after}: {why}", BOUND.as_secs()),
                Err(_) => actix_rt::time::sleep(Duration::from_millis(50)).await,
            }
        }
    }

    /// One look at everything that must hold while clients come and go.
    async fn look(&self) -> Result<(), String> {
        let status = http::try_get(&self.session.url("/status")).await?.json();
        let states: Vec<&str> =
            status["servers"].as_array().unwrap().iter().map(|s| s["state"].as_str().unwrap()).collect();
        if states.iter().any(|state| !matches!(*state, "up" | "full")) {
            return Err(format!("the servers are {states:?}: {status}"));
        }
        // What clients are told is what is true.
        let mut client = Client::connect(&self.session.websocket("/")).await;
        let Heard::Text(told) = client.next().await else {
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
        }
        Ok(())
    }

    fn instance_folders(&self, index: usize) -> usize {
        let runs = std::fs::read_dir(self.folder(index).join("cache/runs")).into_iter().flatten().flatten();
        let inside = runs.flat_map(|run| std::fs::read_dir(run.path()).into_iter().flatten().flatten());
        inside.filter(|entry| entry.file_name().to_string_lossy().starts_with("instance-")).count()
    }

    /// Waits until nothing is left of any simulation: no process, port or folder, and memory as it was.
    pub async fn empty(&mut self) {
        let deadline = Instant::now() + BOUND;
        loop {
            match self.look_for_rests() {
                Ok(()) => break,
                Err(why) if Instant::now() > deadline => panic!("{} s after the class: {why}", BOUND.as_secs()),
                Err(_) => actix_rt::time::sleep(Duration::from_millis(50)).await,
            }
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
            if let Some(port) = (first..first + PLACES).find(|port| is_taken(*port)) {
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

    /// How often all that must hold was found to hold.
    pub fn checks(&self) -> u32 {
        self.checks
    }
}

impl Class {
    /// Waits until all clients have gone. Returns what they have met.
    pub async fn end(mut self) -> Value {
        let deadline = Instant::now() + Duration::from_secs(90);
        while self.child.try_wait().unwrap().is_none() {
            assert!(Instant::now() < deadline, "the class does not end");
            actix_rt::time::sleep(Duration::from_millis(100)).await;
        }
        serde_json::from_str(&std::fs::read_to_string(&self.file).unwrap()).unwrap()
    }
}

impl Drop for Class {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

fn configure(forge: &Forge, webots: &Webots) -> Builder {
    simulation_server(&webots.path(), forge.path(), PLACES)
        .set("hangLimit", 1)
        .set("timing", json!({"grace": 1, "heartbeat": 0.5, "ping": 2, "silence": 6, "launch": 20}))
}

fn session_builder(addresses: &[String], port: u16, folder: &std::path::Path) -> Builder {
    let folder = folder.join("session");
    std::fs::create_dir_all(&folder).unwrap();
    let builder = session_server(addresses).folder(&folder).port(port).set("timing", json!({"answer": 1}));
    // What else runs on this machine must not close the fleet.
    builder.set("loadThreshold", 1000)
}

/// Where the session server finds each simulation server.
fn addresses(ports: &[u16], relay: &Relay) -> Vec<String> {
    let of = |(index, port)| if index == LINKED { relay.port } else { port };
    ports.iter().copied().enumerate().map(of).map(|port| format!("127.0.0.1:{port}")).collect()
}

fn is_taken(port: u16) -> bool {
    std::net::TcpListener::bind((std::net::Ipv4Addr::UNSPECIFIED, port)).is_err()
}

/// What a process has in memory, in bytes.
fn memory(pid: i32) -> u64 {
    let pages = procfs::process::Process::new(pid).and_then(|process| process.statm()).unwrap().resident;
    pages * 4096
}
