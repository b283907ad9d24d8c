//! Commits by their hash: those of branches and tags, and no others that a Git host has.

use super::opened::{cached, reader, world_text};
use crate::support::git::git;
use crate::support::wrapper::Wrapper;
use crate::support::{Forge, WORLD, arm_at, outcome, simulation_server};

#[actix_rt::test]
async fn any_commit_of_a_branch_or_tag_runs() {
    let forge = Forge::new();
    let webots = reader();
    let commit = |branch: &str, text: &str| forge.commit("lab/arm", branch, &[("worlds/a.wbt", &world_text(text))]);
    let commits = [
        commit("main", "first"),
        commit("main", "second"),
        commit("main", "third"),
    ];
    let tagged = [commit("side", "tagged before"), commit("side", "tagged")];
    forge.tag("lab/arm", "v1", "side");
    let bare = forge.path().join("lab/arm");
    git(&bare, &["update-ref", "-d", "refs/heads/side"]);
    // One forge can send commits without their files, the other can't.
    for can_filter in ["true", "false"] {
        git(&bare, &["config", "uploadpack.allowFilter", can_filter]);
        let wrapper = Wrapper::git("");
        let builder = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path());
        let server = builder.start().await;
        let run = async |commit: &str| outcome(&server, &arm_at(commit)).await;
        for (commit, text) in [
            (&commits[0], "first"),
            (&tagged[0], "tagged before"),
            (&commits[1], "second"),
        ] {
            let told = run(commit).await;
            assert!(told.contains(&format!("opened [{text}]")), "{told}");
        }
        let repositories = cached(&server);
        let history = repositories
            .iter()
            .find(|path| path.to_string_lossy().contains("history"))
            .unwrap();
        let objects = git(history, &["cat-file", "--batch-all-objects", "--batch-check"]);
        assert_eq!(objects.contains(" blob "), can_filter == "false", "{objects}");
        let fetches = || wrapper.calls().iter().filter(|call| call.contains(" fetch ")).count();
        assert_eq!(
            fetches(),
            4,
            "three commits, and the history once: {:#?}",
            wrapper.calls()
        );
        // Known commits are not fetched again. The `gc` after a fetch runs in the background.
        let calls = || wrapper.calls().iter().filter(|call| !call.contains(" gc ")).count();
        let before = calls();
        assert!(run(&commits[0]).await.contains("opened [first]"));
        assert_eq!(calls(), before + 2, "ls-tree and checkout: {:#?}", wrapper.calls());
    }
}

#[actix_rt::test]
async fn a_commit_of_no_branch_or_tag_runs_only_with_any_commit() {
    let forge = Forge::with_arm();
    let webots = reader();
    let proposed = forge.commit(
        "lab/arm",
        "proposal",
        &[("worlds/a.wbt", WORLD), ("controllers/c/c.py", "evil")],
    );
    let bare = forge.path().join("lab/arm");
    git(&bare, &["update-ref", "refs/pull/1/head", &proposed]);
    git(&bare, &["update-ref", "-d", "refs/heads/proposal"]);
    let tree = git(&bare, &["rev-parse", "main^{tree}"]);
    let folder = tempfile::tempdir().unwrap();
    let start = |any: bool| {
        let builder = simulation_server(&webots.path(), forge.path(), 2).folder(folder.path());
        builder.set("anyCommit", any).start()
    };
    for can_filter in ["true", "false"] {
        git(&bare, &["config", "uploadpack.allowFilter", can_filter]);
        let none = "0123456789012345678901234567890123456789";
        // What was allowed once need not stay allowed.
        for any in [false, true, false] {
            let server = start(any).await;
            for hash in [proposed.as_str(), tree.trim(), none] {
                let told = outcome(&server, &arm_at(hash)).await;
                if any {
                    assert_eq!(told.contains("opened [WorldInfo"), hash != none, "{told}");
                } else {
                    assert!(
                        told.contains("is in no branch or tag of https://github.com/lab/arm. Git hosts"),
                        "{told}"
                    );
                }
            }
        }
    }
}
