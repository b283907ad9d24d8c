//! Fetches into one cached repository: side by side, each once, and begun anew where they stand still.

use std::path::{Path, PathBuf};

use super::checkout::{outcome, reader, world_text};
use super::git_wrapper::GitWrapper;
use crate::support::client::Client;
use crate::support::git::{Forge, git, world};
use crate::support::program::simulation_server;
use crate::support::until;

/// A forge with `lab/arm`: each of these branches has two worlds that name it.
fn forge(branches: &[&str]) -> Forge {
    let forge = Forge::new();
    for branch in branches {
        let text = world_text(branch);
        forge.commit("lab/arm", branch, &[("worlds/a.wbt", &text), ("worlds/b.wbt", &text)]);
    }
    forge
}

fn repositories(cache: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(cache.join("git")).unwrap().flatten().map(|entry| entry.path());
    entries.filter(|path| path.is_dir()).collect()
}

#[actix_rt::test]
async fn a_commit_that_comes_while_its_parent_is_about_to_be_fetched_is_not_taken_for_its_history() {
    let (forge, webots, marks) = (Forge::new(), reader(), tempfile::tempdir().unwrap());
    forge.commit("lab/arm", "old", &[("worlds/a.wbt", &world_text("old"))]);
    let bare = forge.path().join("lab/arm");
    forge.commit("lab/arm", "old", &[("worlds/a.wbt", &world_text("parent"))]);
    git(&bare, &["branch", "parent", "old"]);
    forge.commit("lab/arm", "old", &[("worlds/a.wbt", &world_text("child"))]);
    git(&bare, &["branch", "child", "old"]);
    // The fetch of the parent waits until the child has come.
    let wrapper = GitWrapper::new(&format!(
        "case \"$*\" in *fetch*heads/parent:*) until [ -e {}/go ]; do sleep 0.05; done;; esac",
        marks.path().display()
    ));
    let server = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path()).start().await;
    let mut parent = Client::start(&server, &world("lab/arm", "parent", "worlds/a.wbt")).await;
    until("it is about to be fetched", async || wrapper.calls().iter().any(|call| call.contains("heads/parent:")))
        .await;
    let told = outcome(&server, &world("lab/arm", "child", "worlds/a.wbt")).await;
    assert!(told.contains("opened [child]"), "{told}");
    std::fs::write(marks.path().join("go"), "").unwrap();
    let told = parent.until("loading: Error:").await;
    assert!(told.contains("opened [parent]"), "{told}");
    git(&repositories(&server.folder.join("cache")).remove(0), &["fsck", "--full"]);
}

#[actix_rt::test]
async fn a_slow_fetch_goes_on_for_who_came_later_for_another_world_of_the_same_commit() {
    let (forge, webots) = (forge(&["main"]), reader());
    let wrapper = GitWrapper::new(
        "case \"$*\" in *fetch*) for n in $(seq 22); do echo \"Receiving objects: $n%\" >&2; sleep 0.5; done;; esac",
    );
    let builder = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path());
    let server = builder.set("timing.checkout", 8).start().await;
    let mut first = Client::start(&server, &world("lab/arm", "main", "worlds/a.wbt")).await;
    first.until("loading: fetching https://github.com/lab/arm: Receiving objects: 11%").await;
    let mut second = Client::start(&server, &world("lab/arm", "main", "worlds/b.wbt")).await;
    second.until("loading: fetching https://github.com/lab/arm: Receiving objects: 1").await;
    assert!(first.until("loading: Error:").await.contains("took longer than 8 seconds"));
    let told = second.until("loading: Error:").await;
    assert!(told.contains("opened [main]"), "{told}");
    assert_eq!(wrapper.calls().iter().filter(|call| call.contains(" fetch ")).count(), 1, "{:#?}", wrapper.calls());
}

#[actix_rt::test]
async fn what_stands_still_is_begun_anew_and_what_moves_is_not() {
    let (forge, webots) = (forge(&["main", "slow"]), reader());
    let marks = tempfile::tempdir().unwrap();
    // Each kind of command hangs once; the fetch of another branch takes its time, but moves.
    let wrapper = GitWrapper::new(&format!(
        "case \"$*\" in *ls-remote*) mkdir {0}/asked 2>/dev/null && exec sleep 1000;; *fetch*heads/main:*) mkdir {0}/fetched 2>/dev/null && exec sleep 1000;; \
         *fetch*heads/slow:*) for n in 1 2 3 4 5 6 7 8 9; do echo \"Receiving objects: $n%\" >&2; sleep 0.5; done;; esac",
        marks.path().display()
    ));
    let builder = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path());
    let server = builder.set("timing.checkout", 12).start().await;
    let told = outcome(&server, &world("lab/arm", "main", "worlds/a.wbt")).await;
    assert!(told.contains("opened [main]"), "{told}");
    assert_eq!(server.log().matches("nothing has come for 3 s, git starts anew").count(), 2, "{}", server.log());
    assert!(marks.path().join("asked").exists() && marks.path().join("fetched").exists());
    let told = outcome(&server, &world("lab/arm", "slow", "worlds/a.wbt")).await;
    assert!(told.contains("opened [slow]"), "{told}");
    assert_eq!(wrapper.calls().iter().filter(|call| call.contains("heads/slow:")).count(), 1, "{:#?}", wrapper.calls());
}

#[actix_rt::test]
async fn a_commit_by_several_names_is_fetched_once() {
    let (forge, webots) = (forge(&["main"]), reader());
    let bare = forge.path().join("lab/arm");
    git(&bare, &["tag", "v1", "main"]);
    let hash = git(&bare, &["rev-parse", "main"]);
    let wrapper = GitWrapper::new(
        "case \"$*\" in *fetch*) for n in $(seq 12); do echo \"Receiving objects: $n%\" >&2; sleep 0.5; done;; esac",
    );
    let builder = simulation_server(&webots.path(), forge.path(), 3).env("PATH", &wrapper.path());
    let server = builder.set("timing.checkout", 9).start().await;
    let mut first = Client::start(&server, &world("lab/arm", "main", "worlds/a.wbt")).await;
    first.until("loading: fetching https://github.com/lab/arm: Receiving objects: 1%").await;
    let mut others = [
        Client::start(&server, &world("lab/arm", "v1", "worlds/a.wbt")).await,
        Client::start(&server, &world("lab/arm", hash.trim(), "worlds/b.wbt")).await,
    ];
    for other in &mut others {
        other.until("loading: fetching https://github.com/lab/arm: Receiving objects: ").await;
    }
    first.until("loading: fetching https://github.com/lab/arm: Receiving objects: 8%").await;
    first.send("nothing that is known").await;
    for other in &mut others {
        let told = other.until("loading: Error:").await;
        assert!(told.contains("opened [main]"), "{told}");
    }
    assert_eq!(wrapper.calls().iter().filter(|call| call.contains(" fetch ")).count(), 1, "{:#?}", wrapper.calls());
}

#[actix_rt::test]
async fn who_joins_the_fetch_of_a_commit_by_another_name_inherits_nothing_of_that_name() {
    // The fetch by the first name takes until both wait for it, and then ends otherwise than that by the second.
    let (refused, moved) =
        ("echo 'fatal: not our ref' >&2; exit 128", "$REAL --git-dir $BARE update-ref refs/heads/main next");
    for (is_hash_first, what_happens, opened) in [(true, refused, ["", "first"]), (false, moved, ["second", "first"])] {
        let (forge, webots, marks) = (Forge::new(), reader(), tempfile::tempdir().unwrap());
        let hash = forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("first"))]);
        forge.commit("lab/arm", "next", &[("worlds/a.wbt", &world_text("second"))]);
        let bare = forge.path().join("lab/arm");
        git(&bare, &["tag", "old", &hash]);
        let [first, second] = if is_hash_first { [hash.as_str(), "main"] } else { ["main", hash.as_str()] };
        let asked = if is_hash_first { format!("+{hash}:") } else { "heads/main:".to_owned() };
        let wrapper = GitWrapper::new(&format!(
            "BARE={}\ncase \"$*\" in *fetch*{asked}*) until [ -e {}/go ]; do echo \"Receiving objects: 1%\" >&2; sleep 0.05; done; {what_happens};; esac",
            bare.display(),
            marks.path().display()
        ));
        let server = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path()).start().await;
        let mut clients = Vec::new();
        for name in [first, second] {
            let mut client = Client::start(&server, &world("lab/arm", name, "worlds/a.wbt")).await;
            client.until("loading: fetching").await;
            clients.push(client);
        }
        std::fs::write(marks.path().join("go"), "").unwrap();
        for (client, opened) in clients.iter_mut().zip(opened) {
            let told = client.until("loading: Error:").await;
            let expected = if opened.is_empty() {
                "has no branch, tag or commit called".to_owned()
            } else {
                format!("opened [{opened}]")
            };
            assert!(told.contains(&expected), "{told}");
        }
        assert_eq!(wrapper.calls().iter().filter(|call| call.contains(" fetch ")).count(), 2, "{:#?}", wrapper.calls());
    }
}
