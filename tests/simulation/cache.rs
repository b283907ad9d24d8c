//! The cache of repositories: its budget, what is damaged, and who may still use what.

use std::path::Path;
use std::time::Duration;

use futures_util::future::join_all;

use super::checkout::{cached, noise, outcome, reader, size_of, world_text};
use super::git_wrapper::GitWrapper;
use super::scene::{arm, instance_folders, nothing_left};
use crate::support::client::Client;
use crate::support::git::{Forge, world};
use crate::support::program::simulation_server;
use crate::support::until;
use crate::support::webots::{Webots, instances_below};

#[actix_rt::test]
async fn the_cache_keeps_to_its_budget() {
    let (forge, webots) = (Forge::new(), reader());
    for name in ["lab/one", "lab/two", "lab/three"] {
        forge.commit(name, "main", &[("worlds/a.wbt", &world_text(name))]);
    }
    let grow = |name: &str, bytes: usize| {
        let work = forge.work_tree(name, "main");
        std::fs::write(work.join(format!("noise{bytes}")), noise(bytes)).unwrap();
        forge.commit_work_tree(name, "main");
    };
    let server = simulation_server(&webots.path(), forge.path(), 2).set("cacheSize", 1).start().await;
    let ask = async |name: &str| assert!(outcome(&server, &world(name, "main", "worlds/a.wbt")).await.contains(name));
    let has = |name: &str| cached(&server).iter().any(|path| path.to_string_lossy().contains(&name.replace('/', "-")));
    for name in ["lab/one", "lab/two", "lab/three"] {
        grow(name, 200_000);
        ask(name).await;
        actix_rt::time::sleep(Duration::from_millis(20)).await;
    }
    assert!(has("lab/one") && has("lab/two") && has("lab/three"));
    // One that was there already grows: it counts too, and the one that was used least recently goes.
    grow("lab/one", 600_000);
    ask("lab/one").await;
    until("the oldest is gone", async || !has("lab/two")).await;
    assert!(has("lab/one") && has("lab/three"));
}

/// Breaks a cached repository.
type Damage = fn(&Path);

#[actix_rt::test]
async fn a_damaged_cache_heals() {
    let (forge, webots) = (Forge::with_arm(), reader());
    let server = simulation_server(&webots.path(), forge.path(), 2).start().await;
    let damage: [(&str, Damage); 5] = [
        ("a pack is cut", |repository| {
            for pack in std::fs::read_dir(repository.join("objects/pack")).unwrap().flatten() {
                if pack.path().extension().is_some_and(|extension| extension == "pack") {
                    std::fs::remove_file(pack.path()).unwrap();
                    std::fs::write(pack.path(), "PACK").unwrap();
                }
            }
        }),
        ("no objects", |repository| std::fs::remove_dir_all(repository.join("objects")).unwrap()),
        ("its settings are noise", |repository| std::fs::write(repository.join("config"), [0xff; 99]).unwrap()),
        ("HEAD is gone", |repository| std::fs::remove_file(repository.join("HEAD")).unwrap()),
        ("an empty reference", |repository| {
            for reference in std::fs::read_dir(repository.join("refs/fleet")).unwrap().flatten() {
                std::fs::write(reference.path(), "").unwrap();
            }
        }),
    ];
    assert!(outcome(&server, &arm()).await.contains("opened"));
    for (what, damage) in damage {
        damage(&cached(&server)[0]);
        let told = outcome(&server, &arm()).await;
        assert!(told.contains("opened [WorldInfo"), "{what}: {told}");
    }
    // Locks that a killed git has left.
    forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("next"))]);
    std::fs::write(cached(&server)[0].join("shallow.lock"), "").unwrap();
    assert!(outcome(&server, &arm()).await.contains("opened [next]"));
}

/// Adds a commit with so many bytes that can't be packed.
fn grow(forge: &Forge, branch: &str, bytes: usize) {
    let work = forge.work_tree("lab/arm", branch);
    std::fs::write(work.join("noise"), noise(bytes)).unwrap();
    forge.commit_work_tree("lab/arm", branch);
}

#[actix_rt::test]
async fn a_repository_in_use_keeps_to_the_budget_too_and_who_runs_keeps_its_commit() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 3).set("cacheSize", 1).start().await;
    let mut running = Client::start(&server, &arm()).await;
    running.until("webots:").await;
    let instance = instance_folders(&server.folder).remove(0);
    for number in 0..6 {
        grow(&forge, "main", 300_000 + number);
        let mut client = Client::start(&server, &arm()).await;
        client.until("webots:").await;
        client.leave().await;
    }
    let folder = server.folder.join("cache/git");
    until("the oldest commits are gone", async || size_of(&folder) < 1 << 20).await;
    assert_eq!(cached(&server).len(), 1);
    let file = instance.join("project/controllers/c/c.py");
    std::fs::write(&file, "changed").unwrap();
    running.send(r#"{"reset controller": "c/c.py"}"#).await;
    running.until("reset controller: c/c.py").await;
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "print('original')\n");
}

#[actix_rt::test]
async fn the_budget_is_kept_at_start_and_when_the_last_user_leaves() {
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let folder = tempfile::tempdir().unwrap();
    let start =
        |size: u32| simulation_server(&webots.path(), forge.path(), 3).folder(folder.path()).set("cacheSize", size);
    let server = start(1).start().await;
    grow(&forge, "main", 2 << 20);
    let mut running = Client::start(&server, &arm()).await;
    running.until("webots:").await;
    assert_eq!(cached(&server).len(), 1, "it is in use");
    running.leave().await;
    until("it is gone with its user", async || cached(&server).is_empty()).await;
    drop(server);
    let server = start(100).start().await;
    let mut running = Client::start(&server, &arm()).await;
    running.until("webots:").await;
    running.leave().await;
    nothing_left(&server, 3).await;
    assert_eq!(cached(&server).len(), 1);
    drop(server);
    let server = start(1).start().await;
    until("it is gone", async || cached(&server).is_empty()).await;
}

#[actix_rt::test]
async fn a_repository_keeps_a_bounded_number_of_commits() {
    let (forge, webots) = (Forge::with_arm(), reader());
    let server = simulation_server(&webots.path(), forge.path(), 1).start().await;
    outcome(&server, &arm()).await;
    let commits = cached(&server)[0].join("refs/fleet");
    let one = std::fs::read_dir(&commits).unwrap().flatten().next().unwrap().path();
    for number in 0..200 {
        std::fs::copy(&one, commits.join(format!("{number:040x}"))).unwrap();
    }
    forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("newer"))]);
    assert!(outcome(&server, &arm()).await.contains("[newer]"));
    let count = || std::fs::read_dir(&commits).unwrap().count();
    until("most are gone", async || count() <= 64).await;
    assert!(count() > 30, "too many are gone");
    until("it is packed", async || server.log().contains("commits from")).await;
    assert!(outcome(&server, &arm()).await.contains("[newer]"));
}

#[actix_rt::test]
async fn tidying_up_that_takes_long_holds_nobody_up_for_long_and_is_not_tried_again_at_once() {
    let forge = Forge::new();
    let branches = ["main", "one", "two", "three", "four"];
    for branch in branches {
        forge.commit("lab/arm", branch, &[("worlds/a.wbt", &world_text(branch))]);
    }
    let webots = reader();
    let wrapper = GitWrapper::new("case \"$*\" in *\" gc \"*) sleep 15;; esac");
    let builder = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path());
    let server = builder.set("timing.checkout", 12).start().await;
    let ask = async |branch: &str| {
        let mut client = Client::start(&server, &world("lab/arm", branch, "worlds/a.wbt")).await;
        let told = client.until("loading: Error:").await;
        assert!(told.contains(&format!("opened [{branch}]")), "{told}");
        client.closed().await;
        client.heard.join("\n")
    };
    ask("main").await;
    // As many packs as a hundred fetches leave.
    let packs = cached(&server)[0].join("objects/pack");
    for file in std::fs::read_dir(&packs).unwrap().flatten().map(|entry| entry.path()).collect::<Vec<_>>() {
        for number in 0..100 {
            let copy = packs.join(format!("pack-{number:040x}")).with_extension(file.extension().unwrap());
            std::fs::copy(&file, copy).unwrap();
        }
    }
    ask("one").await;
    let tried = || wrapper.calls().iter().filter(|call| call.contains(" gc ")).count();
    until("it is tidied up", async || tried() > 0).await;
    let told = ask("two").await;
    assert!(told.contains("waiting while what is cached of https://github.com/lab/arm is tidied up"), "{told}");
    let words = "can't be tidied up, it is left alone for 10 minutes: git gc took longer than 3 seconds";
    assert!(server.log().contains(words), "{}", server.log());
    for branch in ["three", "four"] {
        let told = ask(branch).await;
        assert!(!told.contains("waiting"), "{told}");
    }
    assert_eq!(tried(), 1, "{:#?}", wrapper.calls());
}

#[actix_rt::test]
async fn a_remote_that_fails_has_the_cache_examined_once_in_three_minutes() {
    let (forge, webots) = (Forge::with_arm(), reader());
    let fails = tempfile::tempdir().unwrap();
    let fail = format!("case \"$*\" in *fetch*) [ ! -e {}/now ] || exit 128;; esac", fails.path().display());
    let wrapper = GitWrapper::new(&fail);
    let server = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path()).start().await;
    assert!(outcome(&server, &arm()).await.contains("opened"));
    let examined = || wrapper.calls().iter().filter(|call| call.contains(" fsck ")).count();
    assert_eq!(examined(), 0);
    std::fs::write(fails.path().join("now"), "").unwrap();
    forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("next"))]);
    for _ in 0..3 {
        let told = outcome(&server, &arm()).await;
        assert!(told.contains("git fetch ended with exit code 128"), "{told}");
        assert_eq!(examined(), 1, "{:#?}", wrapper.calls());
    }
    std::fs::remove_file(fails.path().join("now")).unwrap();
    assert!(outcome(&server, &arm()).await.contains("opened [next]"));
}

#[actix_rt::test]
async fn an_examination_that_takes_long_holds_up_nobody_and_goes_on_without_whom_it_is_for() {
    let (forge, webots, marks) = (Forge::with_arm(), reader(), tempfile::tempdir().unwrap());
    forge.commit("lab/leg", "main", &[("worlds/a.wbt", &world_text("leg"))]);
    let wrapper = GitWrapper::new(&format!(
        "case \"$*\" in *\\ fetch\\ *) [ ! -e {0}/fail ] || exit 128;; *\\ fsck\\ *) until [ -e {0}/go ]; do sleep 0.05; done;; esac",
        marks.path().display()
    ));
    let builder = simulation_server(&webots.path(), forge.path(), 4).env("PATH", &wrapper.path());
    let server = builder.set("timing.checkout", 12).start().await;
    let names = ["lab/arm", "lab/leg"];
    for name in names {
        assert!(outcome(&server, &world(name, "main", "worlds/a.wbt")).await.contains("opened"));
        forge.commit(name, "main", &[("worlds/a.wbt", &world_text("next"))]);
    }
    std::fs::write(marks.path().join("fail"), "").unwrap();
    let examined = || wrapper.calls().iter().filter(|call| call.contains(" fsck ")).count();
    let ask = async || {
        let all = names.map(|name| world(name, "main", "worlds/a.wbt"));
        for told in join_all(all.iter().map(|world| outcome(&server, world))).await {
            assert!(told.contains("git fetch ended with exit code 128"), "{told}");
        }
        assert_eq!(examined(), 2, "{:#?}", wrapper.calls());
    };
    ask().await;
    // Who comes next finds the same examinations under way.
    ask().await;
    // What one finds that nobody waits for is known later.
    let broken = cached(&server).into_iter().find(|path| path.to_string_lossy().contains("lab-arm")).unwrap();
    for reference in std::fs::read_dir(broken.join("refs/fleet")).unwrap().flatten() {
        std::fs::write(reference.path(), "").unwrap();
    }
    std::fs::write(marks.path().join("go"), "").unwrap();
    until("both have ended", async || !instances_below(&server.folder).iter().any(|one| one.1.contains("fsck"))).await;
    for name in names {
        let told = outcome(&server, &world(name, "main", "worlds/a.wbt")).await;
        assert!(told.contains("git fetch ended with exit code 128"), "{told}");
    }
    let damaged: Vec<String> =
        server.log().lines().filter(|line| line.contains("is damaged")).map(str::to_owned).collect();
    assert!(damaged.len() == 1 && damaged[0].contains("lab-arm"), "{damaged:#?}");
    assert_eq!(examined(), 3, "what is new is not known yet: {:#?}", wrapper.calls());
    std::fs::remove_file(marks.path().join("fail")).unwrap();
    for name in names {
        assert!(outcome(&server, &world(name, "main", "worlds/a.wbt")).await.contains("opened [next]"));
    }
}

#[actix_rt::test]
async fn a_fetch_that_is_broken_off_leaves_nothing_in_the_cache() {
    let (forge, webots) = (Forge::with_arm(), reader());
    grow(&forge, "main", 30 << 20);
    let builder = simulation_server(&webots.path(), forge.path(), 2).set("cacheSize", 1).set("projectSize", 2);
    let server = builder.start().await;
    let told = outcome(&server, &arm()).await;
    assert!(told.contains("is larger than 2 MiB"), "{told}");
    let folder = server.folder.join("cache/git");
    until("the cache is within its budget", async || size_of(&folder) < 1 << 20).await;
}
