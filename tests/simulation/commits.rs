//! Commits by their hash: those of branches and tags, and nothing that a forge has from elsewhere.

use super::git_wrapper::GitWrapper;
use super::opened::{cached, reader, world_text};
use crate::support::git::git;
use crate::support::{Forge, WORLD, arm, arm_at, is_told, outcome, simulation_server, until, world};

#[actix_rt::test]
async fn any_commit_of_a_branch_or_tag_runs() {
    let (forge, webots) = (Forge::new(), reader());
    let commit = |branch: &str, text: &str| forge.commit("lab/arm", branch, &[("worlds/a.wbt", &world_text(text))]);
    let commits = [commit("main", "first"), commit("main", "second"), commit("main", "third")];
    let tagged = [commit("side", "tagged before"), commit("side", "tagged")];
    forge.tag("lab/arm", "v1", "side");
    let bare = forge.path().join("lab/arm");
    git(&bare, &["update-ref", "-d", "refs/heads/side"]);
    // One forge sends commits alone when it is asked to, the other does not know how.
    for can_filter in ["true", "false"] {
        git(&bare, &["config", "uploadpack.allowFilter", can_filter]);
        let wrapper = GitWrapper::new("");
        let builder = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path());
        let server = builder.start().await;
        let run = async |commit: &str| outcome(&server, &arm_at(commit)).await;
        for (commit, text) in [(&commits[0], "first"), (&tagged[0], "tagged before"), (&commits[1], "second")] {
            let told = run(commit).await;
            assert!(told.contains(&format!("opened [{text}]")), "{told}");
        }
        let repositories = cached(&server);
        let history = repositories.iter().find(|path| path.to_string_lossy().contains("history")).unwrap();
        let objects = git(history, &["cat-file", "--batch-all-objects", "--batch-check"]);
        assert_eq!(objects.contains(" blob "), can_filter == "false", "{objects}");
        let fetches = || wrapper.calls().iter().filter(|call| call.contains(" fetch ")).count();
        assert_eq!(fetches(), 4, "three commits, and the history once: {:#?}", wrapper.calls());
        // What is known is not asked for again.
        // A fetch is followed by gc, which nobody waits for.
        let calls = || wrapper.calls().iter().filter(|call| !call.contains(" gc ")).count();
        let before = calls();
        assert!(run(&commits[0]).await.contains("opened [first]"));
        assert_eq!(calls(), before + 2, "ls-tree and checkout: {:#?}", wrapper.calls());
        // A newer commit than the history has, in which a killed fetch has left locks.
        for lock in ["refs/heads/main.lock", "packed-refs.lock"] {
            std::fs::write(history.join(lock), "").unwrap();
        }
        let next = commit("main", can_filter);
        commit("main", "newest");
        assert!(run(&next).await.contains(&format!("opened [{can_filter}]")));
    }
}

#[actix_rt::test]
async fn a_commit_that_no_branch_or_tag_vouches_for_runs_only_where_that_is_allowed() {
    let (forge, webots) = (Forge::with_arm(), reader());
    let proposed = forge.commit("lab/arm", "proposal", &[("worlds/a.wbt", WORLD), ("controllers/c/c.py", "evil")]);
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
        for hash in [proposed.as_str(), tree.trim(), none] {
            let url = arm_at(hash);
            let server = start(false).await;
            for _ in 0..2 {
                is_told(&server, &url, "is in no branch or tag of https://github.com/lab/arm. Forges").await;
            }
            drop(server);
            // What was allowed once is not allowed for ever.
            let server = start(true).await;
            let told = outcome(&server, &url).await;
            assert_eq!(told.contains("opened [WorldInfo"), hash != none, "{told}");
        }
    }
}

#[actix_rt::test]
async fn a_branch_that_moves_while_it_is_fetched_gives_the_commit_that_it_named() {
    let (forge, webots) = (Forge::new(), reader());
    forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("first"))]);
    let second = forge.commit("lab/arm", "next", &[("worlds/a.wbt", &world_text("second"))]);
    let bare = forge.path().join("lab/arm");
    let moves = format!(
        "case \"$*\" in *\" fetch \"*) env -u GIT_CONFIG_GLOBAL $REAL --git-dir {} update-ref refs/heads/main {second};; esac",
        bare.display()
    );
    let wrapper = GitWrapper::new(&moves);
    let server = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path()).start().await;
    is_told(&server, &arm(), "opened [first]").await;
    is_told(&server, &arm(), "opened [second]").await;
}

#[actix_rt::test]
async fn wrong_names_are_told_in_words_and_no_cache_is_thrown_away_for_them() {
    let (forge, webots) = (Forge::with_arm(), reader());
    let bare = forge.path().join("lab/arm");
    let file = git(&bare, &["rev-parse", "main:worlds/a.wbt"]);
    git(&bare, &["tag", "file", file.trim()]);
    // Folders have all that is needed, though they are no commits.
    let folder = git(&bare, &["rev-parse", "main^{tree}"]);
    git(&bare, &["tag", "folder", folder.trim()]);
    git(&bare, &["tag", "--annotate", "--message", "folder", "noted", folder.trim()]);
    git(&bare, &["tag", "--annotate", "--message", "file", "note", file.trim()]);
    for any in [false, true] {
        let wrapper = GitWrapper::new("");
        let builder = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path());
        let server = builder.set("anyCommit", any).start().await;
        is_told(&server, &arm(), "opened").await;
        for name in ["folder", "noted"] {
            is_told(&server, &arm_at(name), "opened [WorldInfo").await;
        }
        for name in ["file", "note", &"a".repeat(64)] {
            is_told(&server, &arm_at(name), &format!("has no branch, tag or commit called {name:?}")).await;
        }
        assert_eq!(wrapper.calls().iter().filter(|call| call.contains(" init ")).count(), 1, "{:#?}", wrapper.calls());
        assert!(!server.log().contains("broken"), "{}", server.log());
        is_told(&server, &world("lab/none", "main", "worlds/a.wbt"), "does not exist").await;
        let entries = || std::fs::read_dir(server.folder.join("cache/git")).unwrap().flatten();
        until("nothing is left of it", async || {
            !entries().any(|entry| entry.file_name().to_string_lossy().contains("none"))
        })
        .await;
    }
}
