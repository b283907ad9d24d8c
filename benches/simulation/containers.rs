//! Measures starts in containers, one and thirty at once, compared with `docker compose up` by hand.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::Verdict;
use crate::support::client::Client;
use crate::support::git::arm;
use crate::support::program::Server;

#[path = "../../tests/containers/daemon.rs"]
#[expect(dead_code, reason = "tests use the rest")]
mod daemon;
#[path = "../../tests/containers/image.rs"]
mod image;

/// Limit of the time of a start, as a multiple of the time by hand.
const SHARE: f64 = 1.2;
/// Timeout of a start.
const PATIENCE: Duration = Duration::from_secs(300);

/// Compares the median times of these numbers of starts at once, in turns.
pub async fn measure(verdict: &mut Verdict, sizes: &[u16], rounds: usize) {
    let Some(_docker) = daemon::docker().await else { return };
    let most = *sizes.iter().max().unwrap();
    let server = daemon::server(most)
        .set("maxPlacesPerAddress", most)
        .set(
            "timing",
            serde_json::json!({ "launch": 300, "silence": 600, "arrival": 0 }),
        )
        .start()
        .await;
    let mut first = Client::start(&server, &arm()).await;
    first.within("webots:", PATIENCE).await;
    let project = ByHand::of(&server, most);
    first.leave().await;
    gone(&server).await;
    for &size in sizes {
        let mut ours = Vec::new();
        let mut by_hand = Vec::new();
        for _ in 0..rounds {
            by_hand.push(project.up(size));
            ours.push(started(&server, size).await);
        }
        let ours = median(ours);
        let by_hand = median(by_hand);
        let what = format!("{size} at once, until the last is ready");
        let share = ours.as_secs_f64() / by_hand.as_secs_f64();
        println!("{what}: {ours:.2?}, by hand {by_hand:.2?}, {share:.2} times as long");
        verdict.bound(&what, ours, by_hand.mul_f64(SHARE));
    }
}

/// Starts simulations at once, and ends them. Returns the time until the last client has the address of its Webots.
async fn started(server: &Server, count: u16) -> Duration {
    let mut clients = Vec::new();
    for _ in 0..count {
        clients.push(Client::connect(&server.websocket("/client")).await);
    }
    let begin = Instant::now();
    for client in &mut clients {
        client
            .send(&serde_json::json!({ "start": { "url": arm() } }).to_string())
            .await;
    }
    for client in &mut clients {
        client.within("webots:", PATIENCE).await;
    }
    let time = begin.elapsed();
    drop(clients);
    gone(server).await;
    time
}

async fn gone(server: &Server) {
    let deadline = Instant::now() + PATIENCE;
    while !daemon::containers(server).is_empty() {
        assert!(Instant::now() < deadline, "{:?} are left", daemon::containers(server));
        actix_rt::time::sleep(Duration::from_millis(100)).await;
    }
}

/// The compose project of a simulation, copied from the server's files.
struct ByHand {
    folder: tempfile::TempDir,
    image: String,
    ports: Vec<u16>,
}

impl ByHand {
    /// The project of the only running simulation.
    fn of(server: &Server, most: u16) -> Self {
        let runs = std::fs::read_dir(server.cache().join("runs"))
            .unwrap()
            .flatten()
            .map(|run| run.path());
        let instances = runs.flat_map(|run| std::fs::read_dir(run).unwrap().flatten().map(|file| file.path()));
        let instance = instances
            .into_iter()
            .find(|folder| folder.join("compose").is_dir())
            .unwrap();
        let folder = tempfile::tempdir().unwrap();
        let copied = Command::new("cp")
            .arg("-R")
            .arg(instance)
            .arg(folder.path().join("instance"))
            .status()
            .unwrap();
        assert!(copied.success());
        let webots = &daemon::of_service(server, "webots")[0];
        let image = daemon::ask(&["inspect", "--format", "{{.Config.Image}}", webots]);
        let first = crate::support::ports::block(most);
        Self {
            folder,
            image,
            ports: (first..first + most).collect(),
        }
    }

    fn instance(&self) -> PathBuf {
        self.folder.path().join("instance")
    }

    /// Starts `count` projects, each on its own port, and removes them. Returns the time until the last one answers.
    fn up(&self, count: u16) -> Duration {
        let begin = Instant::now();
        let ports = self.ports.iter().take(count.into());
        let children: Vec<_> = ports
            .clone()
            .map(|port| self.compose(*port, &["up", "--detach"]).spawn().unwrap())
            .collect();
        for mut child in children {
            assert!(child.wait().unwrap().success());
        }
        for port in ports.clone() {
            while !answers(*port) {
                assert!(begin.elapsed() < PATIENCE, "port {port} does not answer");
                std::thread::sleep(Duration::from_millis(10));
            }
        }
        let time = begin.elapsed();
        let children = ports.map(|port| self.compose(*port, &["down", "--timeout", "0"]).spawn().unwrap());
        for mut child in children.collect::<Vec<_>>() {
            assert!(child.wait().unwrap().success());
        }
        time
    }

    fn compose(&self, port: u16, words: &[&str]) -> Command {
        let instance = self.instance();
        let folder = self.instance().join("compose");
        let project = std::fs::read_dir(&instance).unwrap().flatten().map(|file| file.path());
        let project = project.into_iter().find(|path| path.join("worlds").is_dir()).unwrap();
        let mut command = compose();
        command
            .args(["--project-name", &format!("by-hand-{port}"), "--project-directory"])
            .arg(&folder);
        // The server's own file has the port in the command.
        let own = self.folder.path().join(format!("{port}.json"));
        std::fs::write(&own, override_for(&folder, port)).unwrap();
        command
            .arg("--file")
            .arg(folder.join("docker-compose.yml"))
            .arg("--file")
            .arg(own)
            .args(words);
        command
            .env("PORT", port.to_string())
            .env("PROJECT", project)
            .env("IMAGE", &self.image);
        command
            .env("BIND", "127.0.0.1")
            .env("PROJECT_PATH", "/usr/local/webots-project");
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        command
    }
}

/// `docker compose` or `docker-compose`, whichever the server uses, for the daemon.
fn compose() -> Command {
    let plugin = Command::new("docker")
        .args(["compose", "version"])
        .output()
        .unwrap()
        .status
        .success();
    let mut command = Command::new(if plugin { "docker" } else { "docker-compose" });
    command
        .args(plugin.then_some("compose"))
        .env("DOCKER_HOST", daemon::host());
    command
}

fn override_for(folder: &Path, port: u16) -> String {
    let text = std::fs::read_to_string(folder.join("override.json")).unwrap();
    let mut file: serde_json::Value = serde_json::from_str(&text).unwrap();
    file["services"]["webots"]["container_name"] = format!("by-hand-{port}").into();
    for word in file["services"]["webots"]["command"].as_array_mut().unwrap() {
        if word.as_str().unwrap().starts_with("--port=") {
            *word = format!("--port={port}").into();
        }
    }
    file.to_string()
}

fn answers(port: u16) -> bool {
    use std::io::{Read, Write};
    let Ok(mut stream) = std::net::TcpStream::connect(("127.0.0.1", port)) else {
        return false;
    };
    stream.set_read_timeout(Some(Duration::from_secs(2))).unwrap();
    let mut answer = [0; 5];
    stream.write_all(b"CTR\nRobot-Name: %2F\n\n").is_ok() && stream.read_exact(&mut answer).is_ok()
}

fn median(mut times: Vec<Duration>) -> Duration {
    times.sort();
    times[times.len() / 2]
}
