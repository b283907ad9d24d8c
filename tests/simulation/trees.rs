//! What is ended where guardians are killed or stopped, and what is not: processes that the server did not start.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::git_wrapper::GitWrapper;
use super::life::{children, is_there, quick};
use super::scene::{DEMO, Scene, State, arm, nothing_left};
use crate::support::client::Client;
use crate::support::git::Forge;
use crate::support::program::{Server, simulation_server};
use crate::support::webots::{Webots, instances_below};
use crate::support::{http, until};

fn runs(folder: &Path) -> BTreeSet<std::path::PathBuf> {
    std::fs::read_dir(folder.join("runs")).into_iter().flatten().map(|entry| entry.unwrap().path()).collect()
}

/// The guardian of the only simulation.
fn guardian(folder: &Path) -> i32 {
    let marked = instances_below(folder);
    marked.iter().find(|one| one.1.contains("guard") && one.1.contains("--remove")).unwrap().0
}

#[actix_rt::test]
async fn servers_that_start_at_once_in_one_cache_keep_their_folders() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    for round in 0..6 {
        let cache = tempfile::tempdir().unwrap();
        let path = cache.path().to_str().unwrap();
        let start = |_| simulation_server(&webots.path(), forge.path(), 1).set("cacheDir", path).spawn();
        let mut servers: Vec<Server> = (0..8).map(start).collect();
        for server in &servers {
            until("it answers", async || http::try_get(&server.url("/health")).await.is_ok()).await;
            assert!(!server.log().contains("earlier runs"), "{}", server.log());
        }
        assert_eq!(runs(cache.path()).len(), 8, "round {round}");
        for server in &mut servers {
            server.signal(Signal::SIGTERM);
        }
        for server in &mut servers {
            assert_eq!(server.ended().await, Some(0));
        }
    }
}

#[actix_rt::test]
async fn a_simulation_outlives_not_the_death_of_both_its_guardian_and_the_server() {
    let mut scene = Scene::new(State::Running, quick).await;
    let guardian = guardian(scene.folder.path());
    // The server can't see the guardian's death.
    scene.server.signal(Signal::SIGSTOP);
    kill(Pid::from_raw(guardian), Signal::SIGKILL).unwrap();
    assert!(instances_below(scene.folder.path()).len() >= 2, "script and simulator");
    scene.server.signal(Signal::SIGKILL);
    scene.server.ended().await;
    until("all processes are gone", async || instances_below(scene.folder.path()).is_empty()).await;
    until("its folder is gone", async || runs(&scene.folder.path().join("cache")).is_empty()).await;
}

/// A simulator that stops its guardian, and hides a process.
fn stopper() -> Webots {
    Webots::script(&format!("kill -STOP $PPID\n(env -i setsid sleep 1000 &)\nexec {DEMO} \"$@\""))
}

#[actix_rt::test]
async fn a_simulator_that_stops_its_guardian_ends() {
    let (forge, webots) = (Forge::with_arm(), stopper());
    let server = quick(simulation_server(&webots.path(), forge.path(), 1)).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("webots:").await;
    let tree = below(server.pid());
    assert!(tree.len() >= 3, "last will, guardian, simulator and what it hides");
    client.leave().await;
    nothing_left(&server, 1).await;
    until("the whole tree is gone", async || below(server.pid()).len() == 1).await;
    assert!(server.log().contains("does not end what it guards"));
}

#[actix_rt::test]
async fn a_server_that_stops_ends_also_a_simulator_that_stops_its_guardian() {
    // The server's own time is over first, or the guardian's.
    for (grace, stop) in [(5.0, 1.0), (0.3, 9.0)] {
        let (forge, webots, folder) = (Forge::with_arm(), stopper(), tempfile::tempdir().unwrap());
        let builder = quick(simulation_server(&webots.path(), forge.path(), 1)).folder(folder.path());
        let mut server = builder.set("timing.grace", grace).set("timing.stop", stop).start().await;
        let mut client = Client::start(&server, &arm()).await;
        client.until("webots:").await;
        let tree = below(server.pid());
        let asked = Instant::now();
        server.signal(Signal::SIGTERM);
        assert_eq!(server.ended().await, Some(0));
        assert!(asked.elapsed() < Duration::from_secs(10));
        until("nothing is left", async || !tree.iter().any(|pid| is_there(*pid))).await;
        assert!(runs(&folder.path().join("cache")).is_empty());
    }
}

/// All processes below one.
fn below(pid: i32) -> Vec<i32> {
    children(pid).into_iter().flat_map(|pid| [vec![pid], below(pid)].concat()).collect()
}

#[actix_rt::test]
async fn children_that_a_server_had_before_its_start_are_spared_with_all_they_leave() {
    let (forge, folder) = (Forge::with_arm(), tempfile::tempdir().unwrap());
    let file = |name: &str| folder.path().join(name);
    let pid_in = async |name: &str| {
        let text = || std::fs::read_to_string(file(name)).unwrap_or_default();
        until(name, async || text().ends_with('\n')).await;
        text().trim().parse::<i32>().unwrap()
    };
    // The one that was there leaves an orphan when it is told to; the simulator hides a process.
    let at = folder.path().display();
    let leave = "while [ ! -e go ]; do sleep 0.02; done; (setsid sleep 1000 & echo $! > left); sleep 1000";
    let before = format!("(cd {at}; exec setsid bash -c '{leave}') &\necho $! > {at}/earlier");
    let webots = Webots::script(&format!("(env -i setsid sleep 1000 & echo $! > {at}/hidden)\n{DEMO} \"$@\" & wait"));
    let builder = quick(simulation_server(&webots.path(), forge.path(), 1)).folder(folder.path());
    let server = builder.before(&before).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("webots:").await;
    std::fs::write(file("go"), "").unwrap();
    let (earlier, left, hidden) = (pid_in("earlier").await, pid_in("left").await, pid_in("hidden").await);
    let _ends = Ends([earlier, left]);
    until("the orphan is the server's", async || children(server.pid()).contains(&left)).await;
    // The server looks each second at what is below its guardians.
    actix_rt::time::sleep(Duration::from_secs(2)).await;
    kill(Pid::from_raw(guardian(folder.path())), Signal::SIGKILL).unwrap();
    client.until("loading: Error:").await;
    nothing_left(&server, 1).await;
    until("what had hidden is gone", async || !is_there(hidden)).await;
    assert!(is_there(earlier) && is_there(left), "{}", server.log());
    assert!(server.log().contains("processes that had lost their guardian"), "{}", server.log());
}

#[actix_rt::test]
async fn what_git_leaves_that_had_no_guardian_ends_without_a_word() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    // As git's own child that reads the remote's folder.
    let wrapper = GitWrapper::new("case \"$*\" in *ls-remote*) sleep 1000;; esac");
    let server = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path()).start().await;
    let sleeps = || instances_below(&server.folder).iter().any(|one| one.1.starts_with("sleep"));
    let client = Client::start(&server, &arm()).await;
    until("git asks", async || sleeps()).await;
    client.leave().await;
    until("what git has started is gone", async || !sleeps()).await;
    until("all is gone", async || below(server.pid()).len() == 1).await;
    nothing_left(&server, 1).await;
    assert!(!server.log().contains("guardian"), "{}", server.log());
}

/// Processes that end with a test.
struct Ends([i32; 2]);

impl Drop for Ends {
    fn drop(&mut self) {
        for pid in self.0 {
            kill(Pid::from_raw(pid), Signal::SIGKILL).ok();
        }
    }
}
