//! Limits of a simulation at each level, and what happens if it exceeds them.

use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use tempfile::TempDir;

use super::deeds::as_nobody;
use super::lives::{long, named};
use crate::simulation::ends::line;
use crate::simulation::scene::{instance_folders, nothing_left};
use crate::support::{
    Builder, Client, DEMO, SOON, Server, Webots, arm, demo_server, holds_soon, http, server_of, session_server, skip,
    until,
};

const LEVELS: [&str; 2] = ["none", "sandbox"];

/// The error for the client of a simulation that does this once it is ready, and must be ended for it.
async fn told_for(deed: &str, level: &str, key: &str, value: u64) -> String {
    let webots = Webots::script(&format!(
        "{DEMO} \"$@\" &\nuntil [ -e go ]; do sleep 0.05; done\n{deed}\nwait"
    ));
    let builder = server_of(webots, 4).set("isolation", level);
    let server = builder.set(&format!("limits.{key}"), value).start().await;
    let mut client = Client::ready(&server).await;
    std::fs::write(instance_folders(&server.folder)[0].join("project/go"), "").unwrap();
    // It sends heartbeats until it is ended, so each text would restart the timeout of `until`.
    let told = actix_rt::time::timeout(2 * SOON, client.until("loading: Error:")).await;
    let told = told.unwrap_or_else(|_| panic!("{level}, {deed}: it was not ended"));
    assert_eq!(client.closed().await, Some(1000));
    nothing_left(&server, 4).await;
    told
}

#[actix_rt::test]
async fn who_fills_the_disk_is_told_and_ended() {
    needs!("bwrap");
    let words = "The simulation has written more than 5 MiB, the limit of this server (limits.disk)";
    let many = |folder: &str| format!("for n in $(seq 20); do head -c 500000 /dev/zero > {folder}/file$n; done");
    let nameless = "for n in $(seq 20); do exec {file}<> own; rm own; head -c 500000 /dev/zero >&$file; done";
    let deep = "deep=$(printf deep/%.0s $(seq 500)); for n in $(seq 6); do mkdir -p $deep; cd $deep; done; head -c 5000000 /dev/zero > file";
    let hidden = "folders that nobody can look into";
    let mut deeds = vec![("sandbox", deep.to_owned(), hidden)];
    deeds.extend(["/tmp", "$HOME", "$XDG_RUNTIME_DIR"].map(|folder| ("sandbox", many(folder), words)));
    for level in LEVELS {
        let slowly = "for n in $(seq 1000); do head -c 50000 /dev/zero > file$n; sleep 0.01; done";
        let small = "for n in $(seq 3000); do echo > small$n; done";
        deeds.extend([slowly, small, nameless].map(|deed| (level, deed.to_owned(), words)));
    }
    // In parallel, because each is counted only every ten seconds.
    let told = deeds.iter().map(|(level, deed, words)| async move {
        let told = told_for(deed, level, "disk", 5).await;
        assert!(told.contains(words), "{level}, {deed}: {told}");
    });
    futures_util::future::join_all(told).await;
}

#[actix_rt::test]
async fn files_are_bounded_in_size_and_those_that_are_open_in_number() {
    needs!("bwrap");
    let script = "head -c 20000000 /dev/zero > large; wc -c < large\n\
        echo \"files $(ulimit -Sn) $(ulimit -Hn) core $(ulimit -c)\"; exit 1";
    for level in LEVELS {
        for (limit, of_the_server, words) in [
            (1500, 5000, "files 1024 1500 core 0"),
            (1500, 1200, "files 1024 1200 core 0"),
            (70, 1200, "files 70 70 core 0"),
        ] {
            let builder = server_of(Webots::script(script), 1)
                .set("isolation", level)
                .set("limits.disk", 5);
            let server = builder
                .set("limits.openFiles", limit)
                .files(of_the_server)
                .start()
                .await;
            let told = Client::start(&server, &arm()).await.until("loading: Error:").await;
            assert!(told.contains(words) && told.contains("5242880"), "{told}");
        }
    }
}

/// The CPU time of a server, in seconds.
fn taken(server: &Server) -> f64 {
    let stat = procfs::process::Process::new(server.pid()).unwrap().stat().unwrap();
    (stat.utime + stat.stime) as f64 / procfs::ticks_per_second() as f64
}

#[actix_rt::test]
async fn a_flood_of_output_costs_no_more_than_a_tenth_of_a_core() {
    needs!("bwrap");
    for (flood, level) in [
        ("yes", "none"),
        ("yes", "sandbox"),
        ("yes .", "none"),
        ("tr '\\0' x < /dev/zero", "none"),
        ("cat /dev/urandom", "none"),
        ("while :; do echo pause; echo fast; done", "none"),
        // A write for each byte, after the server has read the byte before.
        ("python3 -c 'import os\nwhile True: os.write(1, b\"x\")'", "none"),
    ] {
        let webots = Webots::script(&format!("{DEMO} \"$@\" >/dev/null &\n{flood} & wait"));
        let server = server_of(webots, 1).set("isolation", level).start().await;
        let client = Client::ready(&server).await;
        let begin = Instant::now();
        let before = taken(&server);
        let log = server.output_file(&client);
        let size = || -> u64 {
            let files = std::fs::read_dir(log.parent().unwrap()).unwrap().flatten();
            files.map(|file| file.metadata().unwrap().len()).sum()
        };
        until("it has gone on for a while", async || {
            assert!(size() < 1_200_000, "{flood}: {} bytes", size());
            begin.elapsed() > Duration::from_secs(3)
        })
        .await;
        // Endless lines are not written, nor are lines that report events.
        let is_written = ["yes", "cat /dev/urandom"].contains(&flood);
        assert!(!is_written || size() > 500, "{flood}: {} bytes", size());
        let share = (taken(&server) - before) / begin.elapsed().as_secs_f64();
        assert!(share < 0.1, "{flood}, {level}: {share}");
        assert!(http::get(&server.url("/load")).await.text().parse::<f64>().is_ok());
        client.leave().await;
        nothing_left(&server, 1).await;
    }
}

/// A control group that this process may divide as if systemd had delegated it; `None` without cgroup v2.
pub struct Delegated(pub std::path::PathBuf);

impl Delegated {
    pub fn new() -> Option<Self> {
        let mounts = procfs::process::Process::myself().unwrap().mountinfo().unwrap();
        let mount = mounts
            .into_iter()
            .find(|mount| mount.fs_type == "cgroup2" && mount.root == "/")?;
        let folder = mount.mount_point.join(format!("fleet-test-{}", rand::random::<u64>()));
        std::fs::create_dir(&folder).ok().map(|()| Self(folder))
    }

    /// The shell command with which a program joins it.
    pub fn join(&self) -> String {
        format!("echo $$ > {}/cgroup.procs", self.0.display())
    }

    pub fn groups(&self) -> Vec<String> {
        let inside = std::fs::read_dir(&self.0)
            .unwrap()
            .flatten()
            .filter(|entry| entry.path().is_dir());
        inside.map(|entry| entry.file_name().into_string().unwrap()).collect()
    }
}

impl Drop for Delegated {
    fn drop(&mut self) {
        std::fs::write(self.0.join("cgroup.kill"), "1").ok();
        let deadline = Instant::now() + Duration::from_secs(5);
        while self.0.exists() && Instant::now() < deadline {
            for group in self.groups() {
                std::fs::remove_dir(self.0.join(group)).ok();
            }
            std::fs::remove_dir(&self.0).ok();
        }
    }
}

#[actix_rt::test]
async fn a_simulation_has_its_own_control_group() {
    let Some(delegated) = Delegated::new() else {
        return skip("there is no cgroup v2 in which this user may make groups");
    };
    for level in LEVELS {
        let hidden = long();
        let webots = Webots::script(&format!("(env -i setsid sleep {hidden} &)\n{DEMO} \"$@\" & wait"));
        let builder = server_of(webots, 1).set("isolation", level);
        let server = builder.before(&delegated.join()).set("timing.grace", 0.5).start().await;
        let client = Client::ready(&server).await;
        let mut groups = delegated.groups();
        groups.sort();
        assert_eq!(groups.len(), 2, "{groups:?}");
        assert!(
            groups[0] == "server" && groups[1].starts_with("simulation-"),
            "{groups:?}"
        );
        let members = std::fs::read_to_string(delegated.0.join(&groups[1]).join("cgroup.procs")).unwrap();
        assert!(members.lines().count() >= 3, "{members}");
        let id = client.id().to_owned();
        client.leave().await;
        nothing_left(&server, 1).await;
        let time = line(&server, &id).await[9].parse::<f64>().unwrap();
        assert!((0.0..100.0).contains(&time), "{time}");
        until("its group is gone", async || delegated.groups() == ["server"]).await;
        assert_eq!(named(&hidden), [0; 0], "{level}: what hides ends too");
    }
}

/// The start of a server that may have this many processes and threads, as a user of its own with this folder.
fn with_processes(server: Builder, folder: &Path, processes: u32) -> Builder {
    let user = folder.metadata().unwrap().uid();
    let command =
        format!("exec setpriv --reuid={user} --regid={user} --clear-groups prlimit --nproc={processes} \"$0\" \"$@\"");
    server.folder(folder).before(&command)
}

/// A folder of a user that has no process.
fn folder_of_a_user() -> Option<TempDir> {
    as_nobody()?;
    static USERS: AtomicU32 = AtomicU32::new(1);
    let folder = tempfile::tempdir().unwrap();
    let user = (std::process::id() << 8) + USERS.fetch_add(1, Ordering::Relaxed);
    std::os::unix::fs::chown(folder.path(), Some(user), Some(user)).unwrap();
    Some(folder)
}

#[actix_rt::test]
async fn a_server_that_may_start_too_few_threads_serves_or_ends() {
    serves_or_ends(|| demo_server(1).set("isolation", "none"), 6).await;
    serves_or_ends(|| session_server(&[]), 2).await;
}

/// Lets a server start this number of processes and threads, and more.
async fn serves_or_ends(server: impl Fn() -> Builder, least: u32) {
    let cores = u32::try_from(std::thread::available_parallelism().unwrap().get()).unwrap();
    let mut served = false;
    let mut log = String::new();
    for processes in least..=cores + 16 {
        // The guardian of the one before may still be there.
        let Some(folder) = folder_of_a_user() else { return };
        let mut server = with_processes(server(), folder.path(), processes).spawn();
        let mut code = None;
        let decided = holds_soon(async || {
            code = server.exit_code();
            served = http::try_get(&server.url("/health")).await.is_ok();
            served || code.is_some()
        });
        assert!(decided.await, "with {processes}: {}", server.log());
        if let Some(code) = code {
            assert_eq!(code, 1, "with {processes}: {}", server.log());
        } else {
            server.signal(Signal::SIGKILL);
            server.ended().await;
        }
        log = server.log();
        // A worker of actix panics, which ends the server in order.
        assert!(!log.contains("panicked at src/"), "with {processes}: {log}");
    }
    assert!(served, "the largest number is enough: {log}");
}

#[actix_rt::test]
async fn a_server_that_can_start_no_more_threads_is_not_ready() {
    let Some(folder) = folder_of_a_user() else { return };
    let demo = demo_server(1).set("isolation", "none");
    let server = with_processes(demo, folder.path(), 200).start().await;
    assert_eq!(server.health().await, (200, "ok".to_owned()));
    let limit = |processes: u32| {
        // As the server's user, and only the soft limit: who is root in a container may not change others' limits.
        let pid = server.pid();
        let user = folder.path().metadata().unwrap().uid();
        let command =
            format!("setpriv --reuid={user} --regid={user} --clear-groups prlimit --pid={pid} --nproc={processes}:");
        let changed = Command::new("sh").args(["-c", &command]).status().unwrap();
        assert!(changed.success());
    };
    limit(1);
    until("it is not ready", async || {
        let (code, told) = server.health().await;
        code == 503 && told.starts_with("Error: This simulation server can't start a thread: ")
    })
    .await;
    limit(200);
    until("it is ready", async || server.health().await.0 == 200).await;
}
