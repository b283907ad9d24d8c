//! A Docker daemon of the tests' own, shared by all of them. It ends with the process of the tests, and all of its
//! containers with it.

use std::io::Write;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use tokio::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard};

use super::image;
use crate::support::{Builder, Client, SOON, Server, arm, demo_server};

struct Daemon {
    folder: PathBuf,
}

static USERS: RwLock<()> = RwLock::const_new(());
static DAEMON: OnceLock<Option<Daemon>> = OnceLock::new();
/// How long the daemon may take to begin.
const START: Duration = Duration::from_secs(60);
/// How many networks it has room for, so that simulations are soon more.
pub const NETWORKS: u16 = 2;
/// The interface of the servers' network. It stays when the daemon is killed.
const INTERFACE: &str = "webots-fleet";

/// The daemon, started by whoever asks first; nothing, and a word, where there can be none.
pub async fn docker() -> Option<RwLockReadGuard<'static, ()>> {
    let shared = USERS.read().await;
    DAEMON.get_or_init(start).is_some().then_some(shared)
}

/// The same, when nobody else uses it: it may be stopped.
pub async fn alone() -> Option<RwLockWriteGuard<'static, ()>> {
    let alone = USERS.write().await;
    DAEMON.get_or_init(start).is_some().then_some(alone)
}

fn start() -> Option<Daemon> {
    if let Some(why) = missing() {
        assert!(std::env::var_os("CI").is_none(), "this has to be tested where CI is set, and can't: {why}");
        // Not by a macro: what those print is shown for tests that fail only.
        std::io::stderr().write_all(format!("SKIPPED, for {why}: the tests of containers\n").as_bytes()).unwrap();
        return None;
    }
    // Paths of sockets have to be short.
    let below = std::env::temp_dir().join("webots-fleet-docker");
    remove_old(&below);
    let folder = below.join(std::process::id().to_string());
    std::fs::create_dir_all(&folder).unwrap();
    // Unless another daemon of the machine uses it.
    Command::new("ip").args(["link", "del", INTERFACE]).stderr(Stdio::null()).status().unwrap();
    let daemon = Daemon { folder };
    daemon.launch();
    image::make(&daemon.folder);
    Some(daemon)
}

/// Why there can be no daemon here.
fn missing() -> Option<String> {
    if !nix::unistd::getuid().is_root() {
        return Some("dockerd needs root".to_owned());
    }
    let paths = std::env::var_os("PATH").unwrap();
    let is_there = |program: &str| std::env::split_paths(&paths).any(|folder| folder.join(program).is_file());
    let programs = ["dockerd", "docker", "docker-compose", "docker-init", "unshare", "setpriv", "ip"];
    let absent =
        programs.into_iter().find(|program| !is_there(program)).map(|program| format!("there is no {program}"));
    absent.or_else(|| image::prepare().err())
}

/// Removes what earlier runs have left.
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

    /// Starts the daemon as the first process of a namespace: with it everything inside ends.
    fn launch(&self) {
        let folder = self.folder.clone();
        // What one that was killed has left.
        std::fs::remove_file(folder.join("pid")).ok();
        std::fs::remove_dir_all(folder.join("exec")).ok();
        let (socket, log) = (self.socket(), std::fs::File::create(self.folder.join("log")).unwrap());
        // The kernel ends it with the thread that has started it: one that lives as long as this process.
        std::thread::spawn(move || {
            let path = |name: &str| folder.join(name).display().to_string();
            let mut command = Command::new("setpriv");
            command.args(["--pdeathsig", "KILL", "unshare", "--pid", "--fork", "--kill-child=KILL"]);
            command.args(["--mount", "--mount-proc"]);
            command.args(["dockerd", "--host", &socket, "--data-root", &path("data"), "--exec-root", &path("exec")]);
            command.args(["--pidfile", &path("pid"), "--bridge=none", "--ip-masq=false"]);
            command.args(["--iptables=false", "--ip6tables=false"]);
            // Two halves.
            command.arg("--default-address-pool=base=10.213.0.0/16,size=17").process_group(0);
            let outputs = command.stdin(Stdio::null()).stdout(log.try_clone().unwrap()).stderr(log);
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
        command.args(arguments).env("DOCKER_HOST", self.socket()).env("DOCKER_BUILDKIT", "0");
        command
    }
}

fn daemon() -> &'static Daemon {
    DAEMON.get().unwrap().as_ref().unwrap()
}

/// Lets all users of the machine use the daemon, as those in the group `docker` may use that of the machine.
pub fn open_socket() {
    let socket = daemon().folder.join("docker.sock");
    std::fs::set_permissions(socket, std::os::unix::fs::PermissionsExt::from_mode(0o666)).unwrap();
}

/// A user of the machine who is not root, by number.
pub const ORDINARY: u32 = 12345;

/// Has a server, whose files are in this folder, run as an ordinary user.
pub fn as_ordinary(server: Builder, folder: &Path) -> Builder {
    open_socket();
    let owner = format!("{ORDINARY}:{ORDINARY}");
    for path in [server.forge().path(), folder] {
        assert!(Command::new("chown").arg("-R").arg(&owner).arg(path).status().unwrap().success());
    }
    let user = format!("exec setpriv --reuid {ORDINARY} --regid {ORDINARY} --clear-groups \"$0\" \"$@\"");
    server.folder(folder).before(&user)
}

/// Makes an image of an archive, in the daemon whose files are in this folder.
pub fn import(folder: &Path, tar: &str, name: &str) {
    made(folder, &["import", tar, name]);
}

/// Makes an image of a folder with a Dockerfile, in the daemon whose files are in this folder.
pub fn build(folder: &Path, context: &Path, name: &str) {
    made(folder, &["build", "--network", "none", "--tag", name, context.to_str().unwrap()]);
}

/// Makes an image of a Dockerfile that copies nothing.
pub fn build_from(dockerfile: &str, name: &str) {
    let context = tempfile::tempdir().unwrap();
    std::fs::write(context.path().join("Dockerfile"), dockerfile).unwrap();
    build(&daemon().folder, context.path(), name);
}

fn made(folder: &Path, arguments: &[&str]) {
    let made = Daemon { folder: folder.to_owned() }.command(arguments).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

/// How programs reach the daemon.
pub fn host() -> String {
    daemon().socket()
}

/// What `docker` prints with these arguments.
pub fn ask(arguments: &[&str]) -> String {
    let output = daemon().command(arguments).output().unwrap();
    assert!(output.status.success(), "docker {arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

/// A simulation server with so many places that runs simulations in containers of the daemon. It has a forge of its own.
pub fn server(places: u16) -> Builder {
    demo_server(places)
        .set("isolation", "container")
        .set("webots", serde_json::Value::Null)
        // A client of a test reads nothing, not even pings, while the test waits for an image that another one needs.
        .set("timing", serde_json::json!({ "heartbeat": 0.5, "silence": 300 }))
        .env("DOCKER_HOST", &host())
        .env("DOCKER_CONFIG", &daemon().folder.display().to_string())
}

/// Starts a server and a client, whose simulation runs.
pub async fn running(server: Builder) -> (Server, Client) {
    let server = server.start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:").await;
    (server, client)
}

/// What a client is told whose simulation can't run, and the code with which its connection ends.
pub async fn refused(server: &Server, world: &str) -> (String, Option<u16>) {
    let mut client = Client::start(server, world).await;
    (client.patiently("loading: Error:").await, client.closed().await)
}

/// A server with one place, whose project has these files too.
pub fn server_with(files: &[(&str, &str)]) -> Builder {
    let server = server(1);
    server.forge().commit("lab/arm", "main", files);
    server
}

/// The same with a Dockerfile: these lines come after those that copy the project.
pub fn server_built(lines: &str) -> Builder {
    server_with(&[("Dockerfile", &dockerfile(lines))])
}

/// The same with this script as its Webots.
pub fn server_running(webots: &str) -> Builder {
    let install = "RUN install /usr/local/webots-project/fake /usr/local/webots/webots";
    server_with(&[("Dockerfile", &dockerfile(install)), ("fake", &format!("#!/bin/bash\n{webots}\n"))])
}

/// A Dockerfile that copies a project, and has these lines.
pub fn dockerfile(lines: &str) -> String {
    format!("FROM {}\nCOPY . /usr/local/webots-project\n{lines}\n", image::NAME)
}

/// What `--check` prints for a server's configuration.
pub fn check(server: &Server) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_simulation-server"));
    command.arg("--check").arg(server.folder.join("config.json")).env("DOCKER_HOST", host());
    let output = command.output().unwrap();
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// The containers of a server, those that have ended among them.
pub fn containers(server: &Server) -> Vec<String> {
    containers_of(&prefix(server))
}

/// The containers whose names or projects begin like this: their names and projects.
pub fn containers_of(prefix: &str) -> Vec<String> {
    let all = ask(&["ps", "--all", "--format", "{{.Names}} {{.Label \"com.docker.compose.project\"}}"]);
    all.lines().filter(|line| line.split(' ').any(|name| name.starts_with(prefix))).map(str::to_owned).collect()
}

/// How the names of a server's projects begin.
pub fn prefix(server: &Server) -> String {
    let owner = webots_fleet::simulation::container::ResourceOwner::of(&server.cache());
    format!("webots-fleet-{}-", owner.0)
}

/// The containers of one service of a server, as soon as there is one. What a container prints may come before Docker counts
/// it among those that run.
pub fn of_service(server: &Server, service: &str) -> Vec<String> {
    let (prefix, deadline) = (prefix(server), Instant::now() + SOON);
    let filter = format!("label=com.docker.compose.service={service}");
    let format = "{{.Label \"com.docker.compose.project\"}} {{.ID}}";
    loop {
        let all = ask(&["ps", "--filter", &filter, "--format", format]);
        let found = all.lines().filter_map(|line| line.split_once(' ')).filter(|(name, _)| name.starts_with(&prefix));
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

/// Starts it again.
pub fn start_again() {
    daemon().launch();
}
