//! A Docker daemon that all tests here share. It ends with the process of the tests, and so do all its containers.

use std::io::Write;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use tokio::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard};
use webots_fleet::simulation::container::ResourceOwner;

use super::image;
use crate::support::{Builder, Client, SOON, Server, arm, demo_server};

struct Daemon {
    folder: PathBuf,
}

static USERS: RwLock<()> = RwLock::const_new(());
static DAEMON: OnceLock<Option<Daemon>> = OnceLock::new();
/// Timeout of the daemon's start.
const START: Duration = Duration::from_secs(60);
/// Number of networks for which it has room; few, so that simulations soon need more.
pub const NETWORKS: u16 = 2;
/// The bridge of the servers' network. It stays when the daemon is killed.
const INTERFACE: &str = "webots-fleet";

/// The daemon, started by the first caller; `None`, with a reason printed, if there can be none.
pub async fn docker() -> Option<RwLockReadGuard<'static, ()>> {
    let shared = USERS.read().await;
    DAEMON.get_or_init(start).is_some().then_some(shared)
}

/// The daemon without other users, so that it may be stopped.
pub async fn alone() -> Option<RwLockWriteGuard<'static, ()>> {
    let alone = USERS.write().await;
    DAEMON.get_or_init(start).is_some().then_some(alone)
}

fn start() -> Option<Daemon> {
    if let Some(why) = missing() {
        assert!(
            std::env::var_os("CI").is_none(),
            "this has to be tested where CI is set, and can't: {why}"
        );
        // Not with `eprintln!`: its output is shown only if a test fails.
        std::io::stderr()
            .write_all(format!("SKIPPED, for {why}: the tests of containers\n").as_bytes())
            .unwrap();
        return None;
    }
    // Socket paths have a short length limit.
    let below = std::env::temp_dir().join("webots-fleet-docker");
    remove_old(&below);
    let folder = below.join(std::process::id().to_string());
    std::fs::create_dir_all(&folder).unwrap();
    // A daemon that was killed leaves it.
    Command::new("ip")
        .args(["link", "del", INTERFACE])
        .stderr(Stdio::null())
        .status()
        .unwrap();
    let daemon = Daemon { folder };
    daemon.launch();
    image::make(&daemon.folder);
    Some(daemon)
}

/// The reason why there can be no daemon here.
fn missing() -> Option<String> {
    if !nix::unistd::getuid().is_root() {
        return Some("dockerd needs root".to_owned());
    }
    let paths = std::env::var_os("PATH").unwrap();
    let is_there = |program: &str| std::env::split_paths(&paths).any(|folder| folder.join(program).is_file());
    let programs = [
        "dockerd",
        "docker",
        "docker-compose",
        "docker-init",
        "unshare",
        "setpriv",
        "ip",
    ];
    let absent = programs
        .into_iter()
        .find(|program| !is_there(program))
        .map(|program| format!("there is no {program}"));
    absent.or_else(|| image::prepare().err())
}

/// Removes the files of earlier runs.
fn remove_old(folder: &Path) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if !Path::new("/proc").join(&name).exists() {
            std::fs::remove_dir_all(entry.path()).ok();
        }
    }
}

impl Daemon {
    fn socket(&self) -> String {
        format!("unix://{}/docker.sock", self.folder.display())
    }

    /// Starts the daemon as the first process of a PID namespace: everything inside ends with it.
    fn launch(&self) {
        let folder = self.folder.clone();
        // Left by a killed daemon.
        std::fs::remove_file(folder.join("pid")).ok();
        std::fs::remove_dir_all(folder.join("exec")).ok();
        let socket = self.socket();
        let log = std::fs::File::create(self.folder.join("log")).unwrap();
        // The kernel kills it with the thread that started it, so this thread lives as long as the process.
        std::thread::spawn(move || {
            let path = |name: &str| folder.join(name).display().to_string();
            let mut command = Command::new("setpriv");
            command.args(["--pdeathsig", "KILL", "unshare", "--pid", "--fork", "--kill-child=KILL"]);
            command.args(["--mount", "--mount-proc"]);
            command.args([
                "dockerd",
                "--host",
                &socket,
                "--data-root",
                &path("data"),
                "--exec-root",
                &path("exec"),
            ]);
            command.args(["--pidfile", &path("pid"), "--bridge=none", "--ip-masq=false"]);
            command.args(["--iptables=false", "--ip6tables=false"]);
            // Room for two networks.
            command
                .arg("--default-address-pool=base=10.213.0.0/16,size=17")
                .process_group(0);
            let outputs = command
                .stdin(Stdio::null())
                .stdout(log.try_clone().unwrap())
                .stderr(log);
            let mut child = outputs.spawn().unwrap();
            std::fs::write(folder.join("keeper"), child.id().to_string()).unwrap();
            child.wait().ok();
            std::fs::remove_file(folder.join("keeper")).ok();
        });
        let deadline = Instant::now() + START;
        while !self.command(&["version"]).output().unwrap().status.success() {
            let log = std::fs::read_to_string(self.folder.join("log")).unwrap();
            assert!(Instant::now() < deadline, "dockerd does not begin: {log}");
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new("docker");
        command
            .args(arguments)
            .env("DOCKER_HOST", self.socket())
            .env("DOCKER_BUILDKIT", "0");
        command
    }
}

fn daemon() -> &'static Daemon {
    DAEMON.get().unwrap().as_ref().unwrap()
}

/// Lets all users of the machine use the daemon, as the group `docker` may use that of a machine.
pub fn open_socket() {
    let socket = daemon().folder.join("docker.sock");
    std::fs::set_permissions(socket, std::os::unix::fs::PermissionsExt::from_mode(0o666)).unwrap();
}

/// The id of a user who is not root.
pub const ORDINARY: u32 = 12345;

/// Makes a server with files in this folder run as an ordinary user.
pub fn as_ordinary(server: Builder, folder: &Path) -> Builder {
    open_socket();
    let owner = format!("{ORDINARY}:{ORDINARY}");
    for path in [server.forge().path(), folder] {
        assert!(
            Command::new("chown")
                .arg("-R")
                .arg(&owner)
                .arg(path)
                .status()
                .unwrap()
                .success()
        );
    }
    let user = format!("exec setpriv --reuid {ORDINARY} --regid {ORDINARY} --clear-groups \"$0\" \"$@\"");
    server.folder(folder).before(&user)
}

/// Imports an image from an archive, into the daemon with files in this folder.
pub fn import(folder: &Path, tar: &str, name: &str) {
    made(folder, &["import", tar, name]);
}

/// Builds an image from a folder with a Dockerfile, in the daemon with files in this folder.
pub fn build(folder: &Path, context: &Path, name: &str) {
    made(
        folder,
        &["build", "--network", "none", "--tag", name, context.to_str().unwrap()],
    );
}

/// Builds an image from a Dockerfile that copies nothing.
pub fn build_from(dockerfile: &str, name: &str) {
    let context = tempfile::tempdir().unwrap();
    std::fs::write(context.path().join("Dockerfile"), dockerfile).unwrap();
    build(&daemon().folder, context.path(), name);
}

fn made(folder: &Path, arguments: &[&str]) {
    let made = Daemon {
        folder: folder.to_owned(),
    }
    .command(arguments)
    .output()
    .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

/// The folder with its files.
pub fn folder() -> PathBuf {
    daemon().folder.clone()
}

/// The value of `DOCKER_HOST` for the daemon.
pub fn host() -> String {
    daemon().socket()
}

/// The output of `docker` with these arguments.
pub fn ask(arguments: &[&str]) -> String {
    let output = daemon().command(arguments).output().unwrap();
    assert!(
        output.status.success(),
        "docker {arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

/// A simulation server with this many slots that runs simulations in containers of the daemon. It has its own forge.
pub fn server(places: u16) -> Builder {
    demo_server(places)
        .set("isolation", "container")
        .set("webots", serde_json::Value::Null)
        // A test's client reads nothing, not even pings, while the test waits for the image of another simulation.
        .set(
            "timing",
            serde_json::json!({ "heartbeat": 0.5, "silence": 300, "arrival": 0 }),
        )
        .env("DOCKER_HOST", &host())
        .env("DOCKER_CONFIG", &daemon().folder.display().to_string())
}

/// Starts a server, and a client with a running simulation.
pub async fn running(server: Builder) -> (Server, Client) {
    let server = server.start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:").await;
    (server, client)
}

/// The error for a client whose simulation can't run, and the close code.
pub async fn refused(server: &Server, world: &str) -> (String, Option<u16>) {
    let mut client = Client::start(server, world).await;
    (client.patiently("loading: Error:").await, client.closed().await)
}

/// A server with one slot, and with these additional files in the project.
pub fn server_with(files: &[(&str, &str)]) -> Builder {
    let server = server(1);
    server.forge().commit("lab/arm", "main", files);
    server
}

/// The same with a Dockerfile that has these lines after copying the project.
pub fn server_built(lines: &str) -> Builder {
    server_with(&[("Dockerfile", &dockerfile(lines))])
}

/// The same with this script as Webots.
pub fn server_running(webots: &str) -> Builder {
    let install = "RUN install /usr/local/webots-project/fake /usr/local/webots/webots";
    server_with(&[
        ("Dockerfile", &dockerfile(install)),
        ("fake", &format!("#!/bin/bash\n{webots}\n")),
    ])
}

/// A Dockerfile that copies a project and then has these lines.
pub fn dockerfile(lines: &str) -> String {
    format!("FROM {}\nCOPY . /usr/local/webots-project\n{lines}\n", image::NAME)
}

/// The ids of the images that a server has built.
pub fn own_images(server: &Server) -> Vec<String> {
    let name = format!("webots-fleet/{}", ResourceOwner::of(&server.cache()).0);
    let ids = ask(&["image", "ls", "--quiet", "--no-trunc", &name]);
    ids.lines().map(str::to_owned).collect()
}

/// The output of `--check` for a server's configuration.
pub fn check(server: &Server) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_simulation-server"));
    command
        .arg("--check")
        .arg(server.folder.join("config.json"))
        .env("DOCKER_HOST", host());
    let output = command.output().unwrap();
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

/// The containers of a server, including those that have ended.
pub fn containers(server: &Server) -> Vec<String> {
    containers_of(&prefix(server))
}

/// The names and projects of containers whose name or project begins like this.
pub fn containers_of(prefix: &str) -> Vec<String> {
    let all = ask(&[
        "ps",
        "--all",
        "--format",
        "{{.Names}} {{.Label \"com.docker.compose.project\"}}",
    ]);
    all.lines()
        .filter(|line| line.split(' ').any(|name| name.starts_with(prefix)))
        .map(str::to_owned)
        .collect()
}

/// The prefix of the names of a server's projects.
pub fn prefix(server: &Server) -> String {
    let owner = webots_fleet::simulation::container::ResourceOwner::of(&server.cache());
    format!("webots-fleet-{}-", owner.0)
}

/// The running containers of one service of a server, as soon as there is one. Docker may list a container as running
/// only after the container has printed something.
pub fn of_service(server: &Server, service: &str) -> Vec<String> {
    let prefix = prefix(server);
    let deadline = Instant::now() + SOON;
    let filter = format!("label=com.docker.compose.service={service}");
    let format = "{{.Label \"com.docker.compose.project\"}} {{.ID}}";
    loop {
        let all = ask(&["ps", "--filter", &filter, "--format", format]);
        let found = all
            .lines()
            .filter_map(|line| line.split_once(' '))
            .filter(|(name, _)| name.starts_with(&prefix));
        let found: Vec<String> = found.map(|(_, id)| id.to_owned()).collect();
        assert!(Instant::now() < deadline, "there is no container of {service}");
        if !found.is_empty() {
            return found;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Kills the daemon, and with it everything that it runs.
pub fn kill() {
    let keeper = daemon().folder.join("keeper");
    let pid: i32 = std::fs::read_to_string(&keeper).unwrap().parse().unwrap();
    nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), nix::sys::signal::Signal::SIGKILL).unwrap();
    let deadline = Instant::now() + START;
    while keeper.exists() {
        assert!(Instant::now() < deadline, "the daemon is still there");
        std::thread::sleep(Duration::from_millis(20));
    }
}

pub fn start_again() {
    daemon().launch();
}
