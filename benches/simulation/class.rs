//! Measures how long a class takes that starts at once, compared with a bare loop that does the same without a server.
//!
//! The bare loop runs what the server has run for one simulation: `git checkout` of the cached commit, then the command
//! line of that simulation (pasta, bubblewrap and the demo simulator) in its own folders, until the simulator listens
//! on its port, or answers there if pasta forwards the port. For a single start it also runs the two git commands that
//! find the commit, which the server runs only once for a class.

use std::ffi::{OsStr, OsString};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use procfs::process::Process;

use crate::Verdict;
use crate::support::client::Client;
use crate::support::git::{Forge, arm};
use crate::support::program::{Builder, Server, simulation_server};
use crate::support::{SOON, http, until};

/// Limit of the time of a class of 200, as a multiple of that of the bare loop.
const MOST: f64 = 1.5;
/// Limit of the time of one start beyond that of the bare loop.
const ONE: Duration = Duration::from_millis(8);
/// Interval between two checks whether a port is open.
const BETWEEN_LOOKS: Duration = Duration::from_millis(1);

/// Prints how long classes take, in turns with the bare loop.
pub async fn measure(verdict: &mut Verdict, levels: &[String], sizes: &[u16], rounds: usize) {
    println!("clients at once, until the last one is ready (medians):");
    for level in levels {
        let forge = Forge::with_arm();
        let server = server(&forge, level).await;
        let bare = Bare::observe(&server, forge.path().join("lab/arm")).await;
        for &size in sizes {
            let rounds = if size == 1 { 10 * rounds } else { rounds };
            let mut ours = Vec::new();
            let mut theirs = Vec::new();
            for _ in 0..rounds {
                ours.push(class(&server, size).await);
                theirs.push(bare.class(size));
            }
            let ours = median(ours);
            let theirs = median(theirs);
            let ratio = ours.as_secs_f64() / theirs.as_secs_f64();
            println!("  {level:<8}{size:>5}: {ours:>9.3?}, bare loop {theirs:>9.3?}, ratio {ratio:.2}");
            match size {
                1 => verdict.bound("one start beside the bare loop", ours.saturating_sub(theirs), ONE),
                200 => verdict.ratio("200 at once", ratio, MOST),
                _ => {}
            }
        }
    }
}

/// A server with 200 slots at an isolation level; `own` is a sandbox with its own network.
pub async fn server(forge: &Forge, level: &str) -> Server {
    let demo = std::path::Path::new(env!("CARGO_BIN_EXE_demo-simulator"));
    at_level(simulation_server(demo, forge.path(), 200), level)
        .start()
        .await
}

/// A server at an isolation level.
pub fn at_level(builder: Builder, level: &str) -> Builder {
    match level {
        "own" => builder.set("isolation", "sandbox").set("sandbox.network", "own"),
        "sandbox" => builder.set("isolation", "sandbox").set("sandbox.network", "shared"),
        level => builder.set("isolation", level),
    }
}

/// Starts this many clients, and waits until all are ready.
pub async fn ready(server: &Server, size: u16) -> Vec<Client> {
    let one = async |_| {
        let mut client = Client::start(server, &arm()).await;
        client.until("webots:").await;
        client
    };
    futures_util::future::join_all((0..size).map(one)).await
}

/// Makes clients leave, and waits until their simulations have ended.
pub async fn leave(server: &Server, clients: Vec<Client>) {
    futures_util::future::join_all(clients.into_iter().map(Client::leave)).await;
    until("all are gone", async || {
        http::get(&server.url("/status")).await.json()["simulations"]
            .as_array()
            .unwrap()
            .is_empty()
    })
    .await;
}

async fn class(server: &Server, size: u16) -> Duration {
    let begin = Instant::now();
    let clients = ready(server, size).await;
    let time = begin.elapsed();
    leave(server, clients).await;
    time
}

/// What the server has run for one simulation.
struct Bare {
    command: Vec<OsString>,
    environment: Vec<(OsString, OsString)>,
    /// The folder of that simulation, and its port.
    instance: PathBuf,
    port: u16,
    /// The files in that folder: a packet filter, a filter of system calls, and so on.
    files: Vec<(OsString, Vec<u8>)>,
    /// The repository of the Git host, the cached one, and the reference of the commit in the latter.
    remote: PathBuf,
    repository: PathBuf,
    reference: String,
}

impl Bare {
    /// Starts a simulation, and records what the server runs for it.
    async fn observe(server: &Server, remote: PathBuf) -> Self {
        let clients = ready(server, 1).await;
        let shown = http::get(&server.url("/status")).await.json()["simulations"][0].clone();
        let process = Process::new(shown["pid"].as_i64().unwrap().try_into().unwrap()).unwrap();
        // pasta hides its environment, which is that of its children.
        let environment = tree(process.pid())
            .into_iter()
            .find_map(|pid| Process::new(pid).ok()?.environ().ok());
        let environment: Vec<_> = environment.unwrap().into_iter().collect();
        let mark = environment
            .iter()
            .find(|(name, _)| name == "WEBOTS_FLEET_INSTANCE")
            .unwrap()
            .1
            .clone();
        let line = std::fs::read(format!("/proc/{}/cmdline", process.pid())).unwrap();
        let words = line.strip_suffix(b"\0").unwrap().split(|byte| *byte == 0);
        let repositories = std::fs::read_dir(server.cache().join("git")).unwrap().flatten();
        let repository = repositories
            .map(|entry| entry.path())
            .find(|path| path.is_dir())
            .unwrap();
        let commit = std::fs::read_dir(repository.join("refs/fleet"))
            .unwrap()
            .flatten()
            .next()
            .unwrap()
            .file_name();
        let mut command: Vec<OsString> = words.map(|word| OsStr::from_bytes(word).to_owned()).collect();
        let instance = PathBuf::from(mark);
        if command[0].to_string_lossy().ends_with("/bwrap") {
            // bubblewrap reads this file from descriptor 3, which a shell opens.
            let filter = instance.join("system-calls").into();
            let words = ["/bin/sh", "-c", "exec \"$@\" 3<\"$0\""].map(OsString::from);
            command = words.into_iter().chain([filter]).chain(command).collect();
        }
        let plain = std::fs::read_dir(&instance)
            .unwrap()
            .flatten()
            .filter(|one| one.file_type().unwrap().is_file());
        let files = plain
            .map(|one| (one.file_name(), std::fs::read(one.path()).unwrap()))
            .collect();
        let bare = Self {
            command,
            environment,
            instance,
            files,
            port: shown["port"].as_u64().unwrap().try_into().unwrap(),
            remote,
            repository,
            reference: format!("refs/fleet/{}", commit.to_str().unwrap()),
        };
        leave(server, clients).await;
        bare
    }

    /// How long this many starts at once take.
    fn class(&self, size: u16) -> Duration {
        let (sender, started) = std::sync::mpsc::channel();
        let end = std::sync::Barrier::new(usize::from(size) + 1);
        std::thread::scope(|scope| {
            let begin = Instant::now();
            for number in 0..size {
                let sender = sender.clone();
                let end = &end;
                scope.spawn(move || {
                    if size == 1 {
                        self.find();
                    }
                    let mut child = self.start(number);
                    sender.send(number).unwrap();
                    // bubblewrap ends with the thread that started it.
                    end.wait();
                    child.kill().unwrap();
                    child.wait().unwrap();
                    std::fs::remove_dir_all(self.folder(number)).unwrap();
                });
            }
            for number in started.iter().take(usize::from(size)) {
                let deadline = begin + SOON;
                while !self.is_ready(self.port + number) {
                    assert!(Instant::now() < deadline, "simulation {number} does not listen");
                    std::thread::sleep(BETWEEN_LOOKS);
                }
            }
            let time = begin.elapsed();
            end.wait();
            time
        })
    }

    /// pasta accepts connections before anything listens inside.
    fn is_ready(&self, port: u16) -> bool {
        let Ok(mut stream) = TcpStream::connect(("127.0.0.1", port)) else {
            return false;
        };
        let mut answer = [0; 5];
        !self.command[0].to_string_lossy().ends_with("/pasta")
            || stream.write_all(b"CTR\nRobot-Name: %2F\n\n").is_ok() && stream.read_exact(&mut answer).is_ok()
    }

    /// Finds the commit of the branch, and the world in it.
    fn find(&self) {
        self.git(&[
            "ls-remote",
            "--quiet",
            "--",
            self.remote.to_str().unwrap(),
            "refs/heads/main",
            "refs/tags/main",
        ]);
        self.git(&["ls-tree", "-r", "-l", "-z", "--full-tree", &self.reference]);
    }

    fn git(&self, arguments: &[&str]) {
        let mut git = Command::new("git");
        git.arg("--git-dir")
            .arg(&self.repository)
            .args(arguments)
            .env("GIT_CONFIG_GLOBAL", "/dev/null");
        assert!(
            git.stdout(Stdio::null())
                .stderr(Stdio::null())
                .status()
                .unwrap()
                .success(),
            "{arguments:?}"
        );
    }

    fn folder(&self, number: u16) -> PathBuf {
        let mut name = self.instance.clone().into_os_string();
        name.push(format!("-{number}"));
        name.into()
    }

    /// Does for one simulation what the server does.
    fn start(&self, number: u16) -> Child {
        let folder = self.folder(number);
        for name in ["project", "home", "run", "tmp"] {
            std::fs::create_dir_all(folder.join(name)).unwrap();
        }
        for (name, content) in &self.files {
            std::fs::write(folder.join(name), content).unwrap();
        }
        let mut work_tree = OsString::from("--work-tree=");
        work_tree.push(folder.join("project"));
        let git = Command::new("git")
            .arg("--git-dir")
            .arg(&self.repository)
            .arg(work_tree)
            .args(["checkout", "--force", "--progress", &self.reference, "--", "."])
            .env("GIT_INDEX_FILE", folder.join("index"))
            .env("GIT_CONFIG_GLOBAL", "/dev/null")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status();
        assert!(git.unwrap().success());
        // In the arguments of the program, and of pasta.
        let ports = ["--port=", "127.0.0.1/"]
            .map(|word| (format!("{word}{}", self.port), format!("{word}{}", self.port + number)));
        let own = |word: &OsString| {
            let instance = self.instance.as_os_str().as_bytes();
            let word = replaced(word.as_bytes(), instance, folder.as_os_str().as_bytes());
            let of_port =
                |word: Vec<u8>, (old, new): &(String, String)| replaced(&word, old.as_bytes(), new.as_bytes());
            OsString::from_vec(ports.iter().fold(word, of_port))
        };
        let command: Vec<OsString> = self.command.iter().map(own).collect();
        Command::new(&command[0])
            .args(&command[1..])
            .env_clear()
            .envs(self.environment.iter().map(|(name, value)| (name, own(value))))
            .current_dir(folder.join("project"))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap()
    }
}

/// A process and its descendants.
fn tree(root: i32) -> Vec<i32> {
    let children = |pid: i32| std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap_or_default();
    let mut found = vec![root];
    let mut next = 0;
    while let Some(pid) = found.get(next).copied() {
        found.extend(
            children(pid)
                .split_whitespace()
                .map(|child| child.parse::<i32>().unwrap()),
        );
        next += 1;
    }
    found
}

fn replaced(text: &[u8], old: &[u8], new: &[u8]) -> Vec<u8> {
    match text.windows(old.len()).position(|part| part == old) {
        Some(at) => [&text[..at], new, &text[at + old.len()..]].concat(),
        None => text.to_vec(),
    }
}

fn median(mut times: Vec<Duration>) -> Duration {
    times.sort();
    times[times.len() / 2]
}
