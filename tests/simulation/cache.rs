//! The cache of repositories: its size limit, damage, and its owner.

use std::fs::File;
use std::os::unix::fs::{FileExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::future::join_all;
use nix::sys::signal::Signal;

use super::opened::{cached, reader, world_text};
use crate::support::wrapper::Wrapper;
use crate::support::{Client, Forge, Server, arm, is_told, outcome, server_of, simulation_server, until, world};

#[actix_rt::test]
async fn the_cache_keeps_to_its_budget() {
    let forge = Forge::new();
    let webots = reader();
    for name in ["lab/one", "lab/two", "lab/three"] {
        forge.commit(name, "main", &[("worlds/a.wbt", &world_text(name))]);
    }
    let server = simulation_server(&webots.path(), forge.path(), 2)
        .set("cacheSize", 1)
        .start()
        .await;
    let ask = async |name: &str| {
        assert!(
            outcome(&server, &world(name, "main", "worlds/a.wbt"))
                .await
                .contains(name)
        )
    };
    let has = |name: &str| {
        cached(&server)
            .iter()
            .any(|path| path.to_string_lossy().contains(&name.replace('/', "-")))
    };
    for name in ["lab/one", "lab/two", "lab/three"] {
        forge.commit_noise(name, 200_000);
        ask(name).await;
        actix_rt::time::sleep(Duration::from_millis(20)).await;
    }
    assert!(has("lab/one") && has("lab/two") && has("lab/three"));
    // A cached repository grows: this counts too, and the least recently used repository is evicted.
    forge.commit_noise("lab/one", 600_000);
    ask("lab/one").await;
    until("the oldest is gone", async || !has("lab/two")).await;
    assert!(has("lab/one") && has("lab/three"));
}

type Damage = fn(&Path);

#[actix_rt::test]
async fn a_damaged_cache_heals() {
    let server = server_of(reader(), 2).start().await;
    let damage: [(&str, Damage); 5] = [
        ("a pack is cut", cut_packs),
        ("it is empty", |repository| {
            std::fs::remove_dir_all(repository).unwrap();
            std::fs::create_dir(repository).unwrap();
        }),
        ("its settings are noise", |repository| {
            std::fs::write(repository.join("config"), [0xff; 99]).unwrap()
        }),
        ("HEAD is gone", |repository| {
            std::fs::remove_file(repository.join("HEAD")).unwrap()
        }),
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
    // Lock files of a killed git.
    for (mark, lock) in [("next", "shallow.lock"), ("last", "refs/fleet/COMMIT.lock")] {
        let commit = server
            .forge()
            .commit("lab/arm", "main", &[("worlds/a.wbt", &world_text(mark))]);
        std::fs::write(cached(&server)[0].join(lock.replace("COMMIT", &commit)), "").unwrap();
        healed(lock, &format!("opened [{mark}]")).await;
    }
    assert_eq!(cached(&server).len(), 1, "what was broken is gone");
    for folder in ["cache/runs", "cache/git", "cache"] {
        // The server may still be writing into the folder.
        until("it is removed", async || {
            std::fs::remove_dir_all(server.folder.join(folder)).is_ok()
        })
        .await;
        healed(folder, "opened [last]").await;
        let run = std::fs::read_dir(server.folder.join("cache/runs"))
            .unwrap()
            .next()
            .unwrap()
            .unwrap()
            .path();
        assert!(
            std::fs::read_to_string(run.join("gitconfig"))
                .unwrap()
                .contains("hooksPath")
        );
    }
}

fn packs(repository: &Path) -> Vec<PathBuf> {
    let files = std::fs::read_dir(repository.join("objects/pack"))
        .unwrap()
        .flatten()
        .map(|entry| entry.path());
    files
        .filter(|path| path.extension().is_some_and(|extension| extension == "pack"))
        .collect()
}

fn cut_packs(repository: &Path) {
    for pack in packs(repository) {
        // Packs are read-only.
        std::fs::remove_file(&pack).unwrap();
        std::fs::write(&pack, "PACK").unwrap();
    }
}

#[actix_rt::test]
async fn a_damaged_repository_costs_a_class_nothing() {
    let forge = Forge::with_arm();
    let webots = reader();
    forge.commit_noise("lab/arm", 4 << 20);
    let server = simulation_server(&webots.path(), forge.path(), 30).start().await;
    assert!(outcome(&server, &arm()).await.contains("opened"));
    for pack in packs(&cached(&server)[0]) {
        std::fs::set_permissions(&pack, std::fs::Permissions::from_mode(0o644)).unwrap();
        let file = File::options().write(true).open(&pack).unwrap();
        let middle = file.metadata().unwrap().len() / 2;
        file.write_all_at(&[0xff; 1000], middle).unwrap();
    }
    let world = arm();
    let class = join_all((0..30).map(|_| outcome(&server, &world))).await;
    let failed: Vec<_> = class.iter().filter(|told| !told.contains("opened")).collect();
    assert!(failed.is_empty(), "{} of 30: {failed:#?}", failed.len());
    assert_eq!(cached(&server).len(), 1, "what was damaged is gone");
}

#[actix_rt::test]
async fn a_lock_that_a_killed_git_has_left_does_not_stop_packing() {
    let forge = Forge::with_arm();
    let webots = reader();
    let folder = tempfile::tempdir().unwrap();
    let settings = folder.path().join("gitconfig");
    std::fs::write(&settings, "[gc]\n\tautoPackLimit = 2\n").unwrap();
    let builder = simulation_server(&webots.path(), forge.path(), 1);
    let server = builder.set("gitConfig", settings.to_str().unwrap()).start().await;
    let commit = forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("first"))]);
    assert!(outcome(&server, &arm()).await.contains("opened"));
    let repository = &cached(&server)[0];
    // git leaves a few references as they are, and needs no lock then.
    for number in 0..50 {
        std::fs::write(repository.join(format!("refs/tags/{number}")), &commit).unwrap();
    }
    for lock in ["packed-refs.lock", "gc.pid.lock"] {
        std::fs::write(repository.join(lock), "").unwrap();
        for _ in 0..4 {
            forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text(lock))]);
            assert!(outcome(&server, &arm()).await.contains(&format!("opened [{lock}]")));
        }
        until("it is packed", async || packs(repository).len() <= 2).await;
    }
}

#[actix_rt::test]
async fn a_repository_in_use_is_evicted_after_its_last_user() {
    let forge = Forge::with_arm();
    let webots = reader();
    let marks = tempfile::tempdir().unwrap();
    forge.commit_noise("lab/arm", 2 << 20);
    forge.commit("lab/leg", "main", &[("worlds/a.wbt", &world_text("leg"))]);
    let wrapper = Wrapper::git(&format!(
        "case \"$*\" in *lab-arm*checkout*) until [ -e {}/go ]; do sleep 0.05; done;; esac",
        marks.path().display()
    ));
    let has = |server: &Server, name: &str| cached(server).iter().any(|path| path.to_string_lossy().contains(name));
    let builder = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path());
    let server = builder.set("cacheSize", 1).start().await;
    let mut user = Client::start(&server, &arm()).await;
    user.until("loading: Step 8/9 : checking main out").await;
    // Other repositories are fetched and evicted.
    is_told(&server, &world("lab/leg", "main", "worlds/a.wbt"), "opened [leg]").await;
    until("the other has gone", async || !has(&server, "lab-leg")).await;
    assert!(has(&server, "lab-arm"), "it is in use");
    std::fs::write(marks.path().join("go"), "").unwrap();
    assert!(user.until("loading: Error:").await.contains("opened"));
    until("it is gone with its user", async || cached(&server).is_empty()).await;
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
    assert!(
        outcome(&builder().start().await, &arm()).await.contains("opened"),
        "its lock ends with it"
    );
}
