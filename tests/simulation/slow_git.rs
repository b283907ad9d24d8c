//! A git that is slow, hangs, is stopped or killed disturbs nobody else: fetches into one cached repository run one at a time, each
//! commit once, each within the time limit of a checkout.

use std::time::Duration;

use futures_util::future::join_all;

use super::opened::{cached, reader, world_text};
use super::scene::stages;
use crate::support::git::git;
use crate::support::wrapper::Wrapper;
use crate::support::{Client, Forge, arm, arm_at, is_told, simulation_server, until, world};

/// A forge with `lab/arm`: each of these branches has two worlds with the branch's name.
fn forge(branches: &[&str]) -> Forge {
    let forge = Forge::new();
    for branch in branches {
        let text = world_text(branch);
        forge.commit("lab/arm", branch, &[("worlds/a.wbt", &text), ("worlds/b.wbt", &text)]);
    }
    forge
}

/// The commit of a branch.
fn commit(forge: &Forge, branch: &str) -> String {
    git(&forge.path().join("lab/arm"), &["rev-parse", branch])
        .trim()
        .to_owned()
}

#[actix_rt::test]
async fn a_fetch_that_hangs_delays_only_new_commits_of_its_repository() {
    let forge = forge(&["main", "slow", "one"]);
    let webots = reader();
    let main = commit(&forge, "main");
    let slow = commit(&forge, "slow");
    git(&forge.path().join("lab/arm"), &["tag", "as-slow", "slow"]);
    forge.commit("lab/other", "main", &[("worlds/a.wbt", &world_text("other"))]);
    let wrapper = Wrapper::git(&format!(
        "case \"$*\" in *fetch*+{slow}:*) while echo 'halted: 50%' >&2; do sleep 0.2; done;; esac"
    ));
    let builder = simulation_server(&webots.path(), forge.path(), 5).env("PATH", &wrapper.path());
    let server = builder.set("timing.checkout", 40).start().await;
    let ask = async |name: &str, text: &str| {
        is_told(&server, &arm_at(name), &format!("opened [{text}]")).await;
    };
    ask("main", "main").await;
    let fetches = |commit: &str| {
        wrapper
            .calls()
            .iter()
            .filter(|call| call.contains(&format!("+{commit}:")))
            .count()
    };
    let mut stuck = Client::start(&server, &arm_at("slow")).await;
    until("it hangs", async || fetches(&slow) == 1).await;
    ask("main", "main").await;
    ask(&main, "main").await;
    let elsewhere = world("lab/other", "main", "worlds/a.wbt");
    is_told(&server, &elsewhere, "opened [other]").await;
    // A commit is fetched once, whatever the reference and the world, also if the first client has left.
    let mut by_hash = Client::start(&server, &arm_at(&slow)).await;
    by_hash
        .until("loading: Step 2/9 : fetching https://github.com/lab/arm: halted")
        .await;
    let mut heir = Client::start(&server, &world("lab/arm", "as-slow", "worlds/b.wbt")).await;
    heir.until("loading: Step 2/9 : fetching https://github.com/lab/arm: halted")
        .await;
    stuck.send("nothing that is known").await;
    stuck.until("loading: Error:").await;
    until("it has gone", async || stages(&server).await.len() == 2).await;
    // A client that comes late in a fetch has time left after it.
    actix_rt::time::sleep(Duration::from_secs(8)).await;
    let mut next = Client::start(&server, &arm_at("one")).await;
    next.until("loading: Step 2/9 : fetching https://github.com/lab/arm: waiting for another fetch")
        .await;
    assert_eq!(fetches(&slow), 1);
    // The fetch ends at its time limit, for all clients that wait for it.
    let told = heir.until("loading: Error:").await;
    assert!(
        told.ends_with("Fetching https://github.com/lab/arm took longer than 40 seconds"),
        "{told}"
    );
    let told = next.until("loading: Error:").await;
    assert!(told.contains("opened [one]"), "{told}");
    git(&cached(&server)[0], &["fsck", "--full"]);
}

#[actix_rt::test]
async fn a_git_that_is_stopped_fails_once() {
    let forge = &forge(&["main"]);
    // One command of each kind: query, create the repository, fetch, list the files, check them out.
    let kinds = ["ls-remote", "init", "fetch", "ls-tree", "checkout"].map(|command| async move {
        let webots = reader();
        let marks = tempfile::tempdir().unwrap();
        let stop = format!(
            "case \" $* \" in *\" {command} \"*) mkdir {}/stopped 2>/dev/null && kill -STOP $$;; esac",
            marks.path().display()
        );
        let wrapper = Wrapper::git(&stop);
        let builder = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path());
        let server = builder.set("timing.checkout", 10).start().await;
        let ask = async || Client::start(&server, &arm()).await;
        let mut first = ask().await;
        until("it is stopped", async || marks.path().join("stopped").exists()).await;
        let told = first.until("loading: Error:").await;
        assert!(told.ends_with("took longer than 10 seconds"), "git {command}: {told}");
        let told = ask().await.until("loading: Error:").await;
        assert!(told.contains("opened [main]"), "git {command}: {told}");
    });
    join_all(kinds).await;
}

#[actix_rt::test]
async fn a_git_that_is_killed_blames_the_server_and_costs_no_cache() {
    let forge = forge(&["main", "next"]);
    let webots = reader();
    let folder = tempfile::tempdir().unwrap();
    let next = folder.path().join("next");
    // The next command that this file names is killed, as by a kernel without memory.
    let wrapper = Wrapper::git(&format!(
        "if read -r command 2>/dev/null <{next}; then case \" $* \" in *\" $command \"*) rm {next}; kill -KILL $$;; esac; fi",
        next = next.display()
    ));
    let builder = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path());
    let server = builder.start().await;
    is_told(&server, &arm(), "opened [main]").await;
    for (command, branch) in [
        ("ls-remote", "main"),
        ("ls-tree", "main"),
        ("checkout", "main"),
        ("fetch", "next"),
    ] {
        std::fs::write(&next, format!("{command}\n")).unwrap();
        let mut client = Client::start(&server, &arm_at(branch)).await;
        let told = client.until("loading: Error:").await;
        assert_eq!(client.reason()["code"], "server-fault", "git {command}: {told}");
        assert_eq!(client.closed().await, Some(1013), "git {command}");
        is_told(&server, &arm_at(branch), &format!("opened [{branch}]")).await;
    }
    // That of each branch, and the one that was killed.
    assert_eq!(wrapper.count(" fetch "), 3);
}
