//! Projects that are too large, or that take too much.

use super::opened::{reader, size_of, world_text};
use super::scene::nothing_left;
use crate::support::git::git;
use crate::support::wrapper::Wrapper;
use crate::support::{Forge, WORLD, arm, arm_at, is_told, outcome, simulation_server, until, world};

#[actix_rt::test]
async fn sizes_are_limited() {
    let forge = Forge::with_arm();
    let webots = reader();
    let old = git(&forge.path().join("lab/arm"), &["rev-parse", "main"]);
    forge.commit_noise("lab/arm", 6 << 20);
    forge.commit(
        "lab/zeros",
        "main",
        &[("worlds/a.wbt", &world_text("zeros")), ("zeros", &"0".repeat(6 << 20))],
    );
    // The project at the old commit is small, but a fetch by hash gets the whole history from this forge.
    let builder = simulation_server(&webots.path(), forge.path(), 2).set("projectSize", 1);
    let server = builder.set("cacheSize", 1).start().await;
    let told = outcome(&server, &arm()).await;
    assert!(told.ends_with("is larger than 1 MiB"), "{told}");
    let told = outcome(&server, &arm_at(old.trim())).await;
    assert_eq!(
        told,
        "loading: Error: https://github.com/lab/arm with its history is larger than 1 MiB"
    );
    // Cancelled fetches leave nothing.
    let cache = server.folder.join("cache/git");
    until("the cache is within its budget", async || size_of(&cache) < 1 << 20).await;
    let told = outcome(&server, &world("lab/zeros", "main", "worlds/a.wbt")).await;
    assert_eq!(
        told, "loading: Error: The project is larger than 1 MiB",
        "it is small only as it is packed"
    );
    // Countless small files: a folder with ten entries for the same folder, which has ten entries itself, and so on.
    let work = forge.work_tree("lab/bomb", "main");
    std::fs::create_dir_all(work.join("worlds")).unwrap();
    std::fs::write(work.join("worlds/a.wbt"), WORLD).unwrap();
    forge.commit_work_tree("lab/bomb", "main");
    let make_tree = |entries: String| {
        let list = work.join(".git/list");
        std::fs::write(&list, entries).unwrap();
        let file = std::fs::File::open(list).unwrap();
        let made = std::process::Command::new("git")
            .current_dir(&work)
            .arg("mktree")
            .stdin(file)
            .output()
            .unwrap();
        String::from_utf8(made.stdout).unwrap().trim().to_owned()
    };
    let worlds = git(&work, &["rev-parse", "HEAD:worlds"]);
    let words = [(4, "The project is larger than 1 MiB"), (7, "fatal: Out of memory")];
    for (levels, words) in words {
        let mut tree = worlds.trim().to_owned();
        for _ in 0..levels {
            tree = make_tree(
                (0..10)
                    .map(|number| format!("040000 tree {tree}\td{number}\n"))
                    .collect(),
            );
        }
        let root = make_tree(format!(
            "040000 tree {tree}\tbomb\n040000 tree {}\tworlds\n",
            worlds.trim()
        ));
        let commit = git(&work, &["commit-tree", "-m", "bomb", &root]);
        git(
            &work,
            &[
                "push",
                "--quiet",
                "--force",
                "origin",
                &format!("{}:refs/heads/main", commit.trim()),
            ],
        );
        is_told(&server, &world("lab/bomb", "main", "worlds/a.wbt"), words).await;
    }
    nothing_left(&server, 2).await;
}

#[actix_rt::test]
async fn git_is_bounded_in_memory_and_in_what_it_writes() {
    let forge = Forge::with_arm();
    let webots = reader();
    // Small in git's listing, four times as large when checked out.
    let text = "0123456789\n".repeat(50_000);
    let attributes = "*.txt working-tree-encoding=UTF-32LE\n";
    let encoded: Vec<u8> = text.bytes().flat_map(|byte| [byte, 0, 0, 0]).collect();
    let work = forge.work_tree("lab/arm", "main");
    std::fs::write(work.join(".gitattributes"), attributes).unwrap();
    std::fs::write(work.join("a.txt"), encoded).unwrap();
    forge.commit_work_tree("lab/arm", "main");
    let listed = git(&forge.path().join("lab/arm"), &["cat-file", "-s", "main:a.txt"]);
    assert_eq!(listed.trim(), text.len().to_string());
    let server = simulation_server(&webots.path(), forge.path(), 1)
        .set("projectSize", 1)
        .start()
        .await;
    assert_eq!(
        outcome(&server, &arm()).await,
        "loading: Error: The project is larger than 1 MiB"
    );
    // The server sets the limit after it has started git.
    let wrapper = Wrapper::git("until [ \"$(ulimit -d)\" -le 2097152 ] 2>/dev/null; do sleep 0.01; done");
    let server = simulation_server(&webots.path(), forge.path(), 1)
        .env("PATH", &wrapper.path())
        .start()
        .await;
    is_told(&server, &arm(), "opened").await;
}
