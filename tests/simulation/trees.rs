//! What ends with a simulation: without a sandbox its process group; what has left that ends with the server.

use std::path::Path;
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;
use nix::sys::signal::Signal;
use nix::sys::stat::Mode;

use super::git_wrapper::GitWrapper;
use super::life::{is_there, quick};
use super::scene::{instance_folders, nothing_left, stages};
use crate::support::{Client, DEMO, Webots, arm, demo_server, instances_below, server_of, until};

#[actix_rt::test]
async fn without_a_sandbox_the_group_ends_with_its_client_and_the_rest_with_the_server() {
    for reason in ["client", "stop", "kill"] {
        let folder = tempfile::tempdir().unwrap();
        let pids = folder.path().join("pids");
        // One leaves the group and its parent, and keeps its environment. The other drops its environment and stays.
        let tell = |name: &str| format!("echo {name} $$ >> {}; exec sleep 1000", pids.display());
        let (left, stayed) = (tell("left"), tell("stayed"));
        let webots = Webots::script(&format!(
            "(setsid bash -c '{left}' &)\n(env -i bash -c '{stayed}' &)\n{DEMO} \"$@\" & wait"
        ));
        let mut server = quick(server_of(webots, 1)).set("isolation", "none").folder(folder.path()).start().await;
        let client = Client::ready(&server).await;
        let told = || std::fs::read_to_string(&pids).unwrap_or_default();
        until("both are there", async || told().lines().count() == 2).await;
        let pid = |name| told().lines().find_map(|line| line.strip_prefix(name)?.trim().parse().ok()).unwrap();
        let (left, stayed): (i32, i32) = (pid("left"), pid("stayed"));
        assert!(is_there(left) && is_there(stayed), "{reason}");
        if reason == "client" {
            client.leave().await;
            until("its group has ended", async || !is_there(stayed)).await;
            until("its folder is gone", async || instance_folders(folder.path()).is_empty()).await;
            assert!(is_there(left), "what has left the group ends with the server");
        }
        if reason == "kill" {
            server.signal(Signal::SIGKILL);
            server.ended().await;
        } else {
            server.stops().await;
        }
        until(&format!("both have ended: {reason}"), async || !is_there(left) && !is_there(stayed)).await;
        until("its folder is gone", async || instance_folders(folder.path()).is_empty()).await;
    }
}

#[actix_rt::test]
async fn a_simulator_that_was_stopped_by_a_signal_ends() {
    let webots = Webots::script(&format!("{DEMO} \"$@\" &\nkill -STOP $$"));
    let server = quick(server_of(webots, 1)).start().await;
    let client = Client::ready(&server).await;
    client.leave().await;
    nothing_left(&server, 1).await;
}

#[actix_rt::test]
async fn what_git_has_started_ends_with_its_client() {
    // As git's own child that reads the remote's folder.
    let wrapper = GitWrapper::new("case \"$*\" in *ls-remote*) sleep 1000;; esac");
    let server = demo_server(1).env("PATH", &wrapper.path()).start().await;
    let sleeps = || instances_below(&server.folder).iter().any(|one| one.1.starts_with("sleep"));
    let client = Client::start(&server, &arm()).await;
    until("git asks", async || sleeps()).await;
    client.leave().await;
    until("what git has started is gone", async || !sleeps()).await;
    until("all is gone", async || server.children() == [server.guardian()]).await;
    nothing_left(&server, 1).await;
}

/// Makes a chain of nested folders.
fn nest(folder: &Path, levels: usize) {
    let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY;
    let mut deepest = nix::fcntl::open(folder, flags, Mode::empty()).unwrap();
    for _ in 0..levels {
        nix::sys::stat::mkdirat(&deepest, "nested", Mode::S_IRWXU).unwrap();
        deepest = nix::fcntl::openat(&deepest, "nested", flags, Mode::empty()).unwrap();
    }
}

#[actix_rt::test]
async fn a_tree_of_20_000_nested_folders_is_removed_and_ends_nobody_elses_simulation() {
    let server = demo_server(2).files(1024).start().await;
    let client = Client::ready(&server).await;
    let folder = instance_folders(&server.folder).remove(0);
    let other = Client::ready(&server).await;
    nest(&folder, 20_000);
    client.leave().await;
    let begin = Instant::now();
    while folder.exists() {
        assert!(begin.elapsed() < Duration::from_mins(2), "it is still there");
        actix_rt::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(stages(&server).await, ["idle"]);
    other.leave().await;
    nothing_left(&server, 2).await;
}
