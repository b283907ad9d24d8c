//! What ends with a simulation: without a sandbox its process group, and all that carries its mark.

use std::path::Path;
use std::time::{Duration, Instant};

use nix::fcntl::OFlag;
use nix::sys::signal::Signal;
use nix::sys::stat::Mode;

use super::git_wrapper::GitWrapper;
use super::life::{children, guardian, is_there, quick};
use super::scene::{DEMO, arm, instance_folders, nothing_left, stages};
use crate::support::client::Client;
use crate::support::git::Forge;
use crate::support::program::simulation_server;
use crate::support::until;
use crate::support::webots::{Webots, instances_below};

#[actix_rt::test]
async fn the_group_and_all_that_carries_the_mark_end_for_whatever_reason() {
    for reason in ["client", "stop", "kill"] {
        let (forge, folder) = (Forge::with_arm(), tempfile::tempdir().unwrap());
        let pids = folder.path().join("pids");
        // One leaves the group and its parent, and keeps its environment. The other drops its environment and stays.
        let tell = format!("echo $$ >> {}; exec sleep 1000", pids.display());
        let webots =
            Webots::script(&format!("(setsid bash -c '{tell}' &)\n(env -i bash -c '{tell}' &)\n{DEMO} \"$@\" & wait"));
        let builder = quick(simulation_server(&webots.path(), forge.path(), 1)).set("isolation", "none");
        let mut server = builder.folder(folder.path()).start().await;
        let mut client = Client::start(&server, &arm()).await;
        client.until("webots:").await;
        let told = || std::fs::read_to_string(&pids).unwrap_or_default();
        until("both are there", async || told().lines().count() == 2).await;
        let both: Vec<i32> = told().lines().map(|line| line.parse().unwrap()).collect();
        assert!(both.iter().all(|pid| is_there(*pid)), "{reason}");
        match reason {
            "client" => {
                client.leave().await;
                nothing_left(&server, 1).await;
            }
            "stop" => {
                server.signal(Signal::SIGTERM);
                assert_eq!(server.ended().await, Some(0));
            }
            _ => {
                server.signal(Signal::SIGKILL);
                server.ended().await;
            }
        }
        until(&format!("both have ended: {reason}"), async || !both.iter().any(|pid| is_there(*pid))).await;
        until("its folder is gone", async || instance_folders(folder.path()).is_empty()).await;
    }
}

#[actix_rt::test]
async fn a_simulator_that_was_stopped_by_a_signal_ends() {
    let forge = Forge::with_arm();
    let webots = Webots::script(&format!("{DEMO} \"$@\" &\nkill -STOP $$"));
    let server = quick(simulation_server(&webots.path(), forge.path(), 1)).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("webots:").await;
    client.leave().await;
    nothing_left(&server, 1).await;
}

#[actix_rt::test]
async fn what_git_has_started_ends_with_its_client() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    // As git's own child that reads the remote's folder.
    let wrapper = GitWrapper::new("case \"$*\" in *ls-remote*) sleep 1000;; esac");
    let server = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path()).start().await;
    let sleeps = || instances_below(&server.folder).iter().any(|one| one.1.starts_with("sleep"));
    let client = Client::start(&server, &arm()).await;
    until("git asks", async || sleeps()).await;
    client.leave().await;
    until("what git has started is gone", async || !sleeps()).await;
    until("all is gone", async || children(server.pid()) == [guardian(&server)]).await;
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
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 2).files(1024).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("webots:").await;
    let folder = instance_folders(&server.folder).remove(0);
    let mut other = Client::start(&server, &arm()).await;
    other.until("webots:").await;
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
