//! Fetches into one cached repository: side by side, each once, and begun anew where they stand still.

use std::path::{Path, PathBuf};

use nix::sys::signal::Signal;

use super::checkout::{outcome, reader, world_text};
use super::git_wrapper::GitWrapper;
use super::scene::{nothing_left, stages};
use crate::support::client::Client;
use crate::support::git::{Forge, git, world};
use crate::support::program::{Server, simulation_server};
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

/// Waits until no more than so many simulations are left.
async fn gone_but_for(server: &Server, others: usize) {
    until("it has gone", async || stages(server).await.len() == others).await;
}

fn repositories(cache: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(cache.join("git")).unwrap().flatten().map(|entry| entry.path());
    entries.filter(|path| path.is_dir()).collect()
}

#[actix_rt::test]
async fn a_fetch_that_hangs_holds_up_nobody_else_who_uses_its_repository() {
    let branches = ["main", "slow", "one", "two", "three"];
    let (forge, webots) = (forge(&branches), reader());
    let cache = tempfile::tempdir().unwrap();
    let hangs = cache.path().join("hangs");
    std::fs::write(&hangs, "").unwrap();
    let wrapper = GitWrapper::new(&format!(
        "case \"$*\" in *fetch*refs/heads/slow:*) while [ -e {} ]; do sleep 0.05; done;; esac",
        hangs.display()
    ));
    let start = || {
        let builder = simulation_server(&webots.path(), forge.path(), 4).env("PATH", &wrapper.path());
        builder.set("cacheDir", cache.path().to_str().unwrap()).start()
    };
    let (one, other) = (start().await, start().await);
    let main = world("lab/arm", "main", "worlds/a.wbt");
    assert!(outcome(&one, &main).await.contains("opened [main]"));
    let fetches =
        |branch: &str| wrapper.calls().iter().filter(|call| call.contains(&format!("heads/{branch}:"))).count();
    let mut stuck = Client::start(&one, &world("lab/arm", "slow", "worlds/a.wbt")).await;
    until("it hangs", async || fetches("slow") == 1).await;
    // Other branches, be they cached or not, and a commit that is cached.
    let commit = git(&forge.path().join("lab/arm"), &["rev-parse", "main"]);
    for (server, name, text) in [
        (&one, "one", "one"),
        (&other, "two", "two"),
        (&one, "main", "main"),
        (&other, "main", "main"),
        (&one, commit.trim(), "main"),
        (&other, commit.trim(), "main"),
    ] {
        let told = outcome(server, &world("lab/arm", name, "worlds/a.wbt")).await;
        assert!(told.contains(&format!("opened [{text}]")), "{name}: {told}");
    }
    // The same commit is fetched once, for worlds and servers that differ, also when the first has left.
    let mut heirs = [
        Client::start(&one, &world("lab/arm", "slow", "worlds/b.wbt")).await,
        Client::start(&other, &world("lab/arm", "slow", "worlds/b.wbt")).await,
    ];
    for heir in &mut heirs {
        heir.until("loading: looking for").await;
    }
    assert!(outcome(&one, &world("lab/arm", "three", "worlds/a.wbt")).await.contains("opened [three]"));
    assert_eq!(fetches("slow"), 1, "{:#?}", wrapper.calls());
    stuck.send("nothing that is known").await;
    stuck.until("loading: Error:").await;
    gone_but_for(&one, 1).await;
    std::fs::remove_file(&hangs).unwrap();
    for heir in &mut heirs {
        let told = heir.until("loading: Error:").await;
        assert!(told.contains("opened [slow]"), "{told}");
    }
    assert_eq!(fetches("slow"), 1, "{:#?}", wrapper.calls());
    for server in [&one, &other] {
        nothing_left(server, 4).await;
    }
    // The cache is in order, has all five commits, and no rest of the fetches.
    let repository = repositories(cache.path()).remove(0);
    git(&repository, &["fsck", "--full"]);
    assert_eq!(std::fs::read_dir(repository.join("refs/fleet")).unwrap().count(), branches.len());
    let rests = || std::fs::read_dir(repository.join("quarantine")).unwrap().count();
    until("what fetches have left is gone", async || rests() == 0).await;
}

#[actix_rt::test]
async fn who_waits_for_the_fetch_of_a_server_that_is_killed_takes_over() {
    let (forge, webots, cache) = (forge(&["main"]), reader(), tempfile::tempdir().unwrap());
    let start = |wrapper: &GitWrapper| {
        let builder = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path());
        builder.set("cacheDir", cache.path().to_str().unwrap()).start()
    };
    // Half a pack and a lock, and nothing more.
    let hangs = GitWrapper::new(
        "case \"$*\" in *fetch*) mkdir -p \"$3/objects/pack\"; echo PACK > \"$3/objects/pack/tmp_pack_x\"; echo > \"$3/shallow.lock\"; exec sleep 1000;; esac",
    );
    let watched = GitWrapper::new("");
    let (mut one, other) = (start(&hangs).await, start(&watched).await);
    let _stuck = Client::start(&one, &world("lab/arm", "main", "worlds/a.wbt")).await;
    let half =
        || repositories(cache.path()).iter().any(|path| holds(path, "tmp_pack_x") && holds(path, "shallow.lock"));
    until("it hangs", async || half()).await;
    let mut heir = Client::start(&other, &world("lab/arm", "main", "worlds/a.wbt")).await;
    heir.until("loading: looking for").await;
    let fetches = || watched.calls().iter().any(|call| call.contains(" fetch "));
    until("its commit is known", async || watched.calls().iter().any(|call| call.contains("ls-remote"))).await;
    assert!(!fetches(), "{:#?}", watched.calls());
    one.signal(Signal::SIGKILL);
    one.ended().await;
    let told = heir.until("loading: Error:").await;
    assert!(told.contains("opened [main]"), "{told}");
    until("the half is gone", async || !half()).await;
}

/// Whether there is a file of this name anywhere below a folder.
fn holds(folder: &Path, name: &str) -> bool {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.into_iter().any(|path| path.file_name().is_some_and(|one| one == name) || holds(&path, name))
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
