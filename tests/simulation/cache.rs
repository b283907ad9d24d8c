//! The cache of repositories: its budget, what is damaged, and whose it is.

use std::path::Path;
use std::time::Duration;

use nix::sys::signal::Signal;

use super::git_wrapper::GitWrapper;
use super::opened::{cached, reader, size_of, world_text};
use super::scene::instance_folders;
use crate::support::{
    Client, Forge, Server, arm, arm_at, demo_server, is_told, outcome, server_of, simulation_server, until, world,
};

#[actix_rt::test]
async fn the_cache_keeps_to_its_budget() {
    let (forge, webots) = (Forge::new(), reader());
    for name in ["lab/one", "lab/two", "lab/three"] {
        forge.commit(name, "main", &[("worlds/a.wbt", &world_text(name))]);
    }
    let server = simulation_server(&webots.path(), forge.path(), 2).set("cacheSize", 1).start().await;
    let ask = async |name: &str| assert!(outcome(&server, &world(name, "main", "worlds/a.wbt")).await.contains(name));
    let has = |name: &str| cached(&server).iter().any(|path| path.to_string_lossy().contains(&name.replace('/', "-")));
    for name in ["lab/one", "lab/two", "lab/three"] {
        forge.commit_noise(name, 200_000);
        ask(name).await;
        actix_rt::time::sleep(Duration::from_millis(20)).await;
    }
    assert!(has("lab/one") && has("lab/two") && has("lab/three"));
    // One that was there already grows: it counts too, and the one that was used least recently goes.
    forge.commit_noise("lab/one", 600_000);
    ask("lab/one").await;
    until("the oldest is gone", async || !has("lab/two")).await;
    assert!(has("lab/one") && has("lab/three"));
}

/// Breaks a cached repository.
type Damage = fn(&Path);

#[actix_rt::test]
async fn a_damaged_cache_heals() {
    let server = server_of(reader(), 2).start().await;
    let damage: [(&str, Damage); 9] = [
        ("a pack is cut", |repository| change_packs(repository, |bytes| bytes.truncate(4))),
        ("a pack has noise", |repository| {
            change_packs(repository, |bytes| {
                let end = bytes.len() - 30;
                bytes[40..end].fill(0x55);
            });
        }),
        ("it is empty", |repository| {
            std::fs::remove_dir_all(repository).unwrap();
            std::fs::create_dir(repository).unwrap();
        }),
        ("its init was killed", |repository| {
            std::fs::remove_dir_all(repository).unwrap();
            std::fs::create_dir(repository).unwrap();
            std::fs::write(repository.join("config.lock"), "").unwrap();
        }),
        ("it is gone", |repository| std::fs::remove_dir_all(repository).unwrap()),
        ("no objects", |repository| std::fs::remove_dir_all(repository.join("objects")).unwrap()),
        ("its settings are noise", |repository| std::fs::write(repository.join("config"), [0xff; 99]).unwrap()),
        ("HEAD is gone", |repository| std::fs::remove_file(repository.join("HEAD")).unwrap()),
        ("an empty reference", |repository| {
            for reference in std::fs::read_dir(repository.join("refs/fleet")).unwrap().flatten() {
                std::fs::write(reference.path(), "").unwrap();
            }
        }),
    ];
    let healed = async |damage: &str, opened: &str| {
        let told = outcome(&server, &arm()).await;
        assert!(told.contains(opened), "{damage}: {told}");
    };
    healed("nothing yet", "opened").await;
    for (name, damage) in damage {
        damage(&cached(&server)[0]);
        healed(name, "opened [WorldInfo").await;
    }
    // Locks that a killed git has left.
    for (mark, lock) in [("next", "shallow.lock"), ("last", "refs/fleet/COMMIT.lock")] {
        let commit = server.forge().commit("lab/arm", "main", &[("worlds/a.wbt", &world_text(mark))]);
        std::fs::write(cached(&server)[0].join(lock.replace("COMMIT", &commit)), "").unwrap();
        healed(lock, &format!("opened [{mark}]")).await;
    }
    assert_eq!(cached(&server).len(), 1, "what was broken is gone");
    for folder in ["cache/runs", "cache/git", "cache"] {
        // The server may still be writing into it.
        until("it is removed", async || std::fs::remove_dir_all(server.folder.join(folder)).is_ok()).await;
        healed(folder, "opened [last]").await;
        let run = std::fs::read_dir(server.folder.join("cache/runs")).unwrap().next().unwrap().unwrap().path();
        assert!(std::fs::read_to_string(run.join("gitconfig")).unwrap().contains("hooksPath"));
    }
}

fn change_packs(repository: &Path, change: impl Fn(&mut Vec<u8>)) {
    let files = std::fs::read_dir(repository.join("objects/pack")).unwrap().flatten().map(|entry| entry.path());
    for pack in files.filter(|path| path.extension().is_some_and(|extension| extension == "pack")) {
        let mut bytes = std::fs::read(&pack).unwrap();
        change(&mut bytes);
        std::fs::remove_file(&pack).unwrap();
        std::fs::write(&pack, bytes).unwrap();
    }
}

#[actix_rt::test]
async fn who_runs_is_not_hurt_when_the_cached_repository_goes() {
    let server = demo_server(2).start().await;
    let mut running = Client::ready(&server).await;
    let file = instance_folders(&server.folder)[0].join("project/controllers/c/c.py");
    let mut reset = async || {
        std::fs::write(&file, "changed").unwrap();
        assert_eq!(running.reset("c/c.py").await, "reset controller: c/c.py");
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "print('original')\n");
    };
    // It is broken, and is fetched again.
    std::fs::write(cached(&server)[0].join("config"), "[noise").unwrap();
    reset().await;
    // It is gone: the client's commit is fetched again, also when its branch has moved on.
    std::fs::remove_dir_all(&cached(&server)[0]).unwrap();
    server.forge().commit("lab/arm", "main", &[("controllers/c/c.py", "newer")]);
    reset().await;
}

#[actix_rt::test]
async fn a_repository_that_is_being_used_stays_and_goes_with_its_last_user_where_the_budget_is_exceeded() {
    let (forge, webots, marks) = (Forge::with_arm(), reader(), tempfile::tempdir().unwrap());
    forge.commit_noise("lab/arm", 2 << 20);
    forge.commit("lab/leg", "main", &[("worlds/a.wbt", &world_text("leg"))]);
    let wrapper = GitWrapper::new(&format!(
        "case \"$*\" in *lab-arm*checkout*) until [ -e {}/go ]; do sleep 0.05; done;; esac",
        marks.path().display()
    ));
    let folder = tempfile::tempdir().unwrap();
    let start = |size: u32| {
        let builder = simulation_server(&webots.path(), forge.path(), 2).folder(folder.path());
        builder.env("PATH", &wrapper.path()).set("cacheSize", size).start()
    };
    let has = |server: &Server, name: &str| cached(server).iter().any(|path| path.to_string_lossy().contains(name));
    let server = start(1).await;
    let mut user = Client::start(&server, &arm()).await;
    user.until("loading: Step 8/9 : checking main out").await;
    // Others come and go.
    is_told(&server, &world("lab/leg", "main", "worlds/a.wbt"), "opened [leg]").await;
    until("the other has gone", async || !has(&server, "lab-leg")).await;
    assert!(has(&server, "lab-arm"), "it is in use");
    std::fs::write(marks.path().join("go"), "").unwrap();
    assert!(user.until("loading: Error:").await.contains("opened"));
    until("it is gone with its user", async || cached(&server).is_empty()).await;
    drop(server);
    let server = start(100).await;
    is_told(&server, &arm(), "opened").await;
    assert_eq!(cached(&server).len(), 1);
    drop(server);
    let server = start(1).await;
    until("it is gone at the start", async || cached(&server).is_empty()).await;
}

#[actix_rt::test]
async fn packing_that_takes_long_holds_nobody_up_for_long() {
    let (forge, webots) = (Forge::new(), reader());
    for branch in ["main", "one"] {
        forge.commit("lab/arm", branch, &[("worlds/a.wbt", &world_text(branch))]);
    }
    let wrapper = GitWrapper::new("case \"$*\" in *\" gc \"*) exec sleep 1000;; esac");
    let builder = simulation_server(&webots.path(), forge.path(), 1).env("PATH", &wrapper.path());
    let server = builder.set("timing.checkout", 12).start().await;
    let ask = async |branch: &str| {
        let mut client = Client::start(&server, &arm_at(branch)).await;
        let told = client.until("loading: Error:").await;
        assert!(told.contains(&format!("opened [{branch}]")), "{told}");
        client.closed().await;
        client.heard.join("\n")
    };
    ask("main").await;
    assert!(!ask("main").await.contains("waiting for another fetch"), "what is cached needs no turn");
    let told = ask("one").await;
    assert!(told.contains("fetching https://github.com/lab/arm: waiting for another fetch"), "{told}");
    assert!(server.log().contains("can't be packed"), "{}", server.log());
}

#[actix_rt::test]
async fn a_remote_that_fails_costs_nothing_of_the_cache() {
    let fails = tempfile::tempdir().unwrap();
    let fail = "echo 'fatal: early EOF' >&2; exit 128";
    let script = format!("case \"$*\" in *fetch*) [ ! -e {}/now ] || {{ {fail}; }};; esac", fails.path().display());
    let wrapper = GitWrapper::new(&script);
    let server = server_of(reader(), 1).env("PATH", &wrapper.path()).start().await;
    let forge = server.forge();
    forge.commit_noise("lab/arm", 1 << 20);
    is_told(&server, &arm(), "opened").await;
    let before = size_of(&cached(&server)[0]);
    std::fs::write(fails.path().join("now"), "").unwrap();
    let commit = forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("next"))]);
    let fetches = || wrapper.calls().iter().filter(|call| call.contains(&format!("+{commit}"))).count();
    for number in 1..=2 {
        is_told(&server, &arm(), "git fetch ended with exit code 128: fatal: early EOF").await;
        assert_eq!(fetches(), number, "it is not tried again by itself");
        assert_eq!(size_of(&cached(&server)[0]), before);
    }
    std::fs::remove_file(fails.path().join("now")).unwrap();
    is_told(&server, &arm(), "opened [next]").await;
}

#[actix_rt::test]
async fn a_cache_belongs_to_one_server() {
    let folder = tempfile::tempdir().unwrap();
    let builder = || server_of(reader(), 1).set("cacheDir", folder.path().to_str().unwrap());
    let mut one = builder().start().await;
    let said = builder().refused(1).await;
    let words = "(cacheDir) can't be used: another simulation server uses it, and each needs one of its own";
    assert!(said.contains(words), "{said}");
    is_told(&one, &arm(), "opened").await;
    one.signal(Signal::SIGKILL);
    one.ended().await;
    assert!(outcome(&builder().start().await, &arm()).await.contains("opened"), "its lock ends with it");
}
