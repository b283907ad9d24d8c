//! Checkouts: what a URL refers to, what is cached, and what a malicious repository can't do. A git that is slow or hangs:
//! `slow_git`.

use std::path::Path;

use futures_util::future::join_all;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::opened::{cached, reader, size_of, world_text};
use super::scene::{instance_folders, nothing_left};
use crate::support::git::git;
use crate::support::wrapper::Wrapper;
use crate::support::{
    Client, Forge, Webots, arm, arm_at, demo_server, instances_below, is_told, outcome, server_of, simulation_server,
    until, world,
};

#[actix_rt::test]
async fn every_kind_of_url_opens_its_world() {
    let forge = Forge::new();
    let webots = reader();
    let first = forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("root of main"))]);
    forge.tag("lab/arm", "v1.0", "main");
    forge.commit(
        "lab/arm",
        "main",
        &[
            ("worlds/a.wbt", &world_text("newer")),
            ("p q/worlds/b é.wbt", &world_text("spaces")),
        ],
    );
    forge.commit(
        "lab/arm",
        "feature/arm",
        &[("sub/worlds/a.wbt", &world_text("slashes"))],
    );
    let quote = "q'\"$(touch${IFS}pwned)`id`";
    forge.commit("lab/arm", quote, &[("worlds/a.wbt", &world_text("quotes"))]);
    forge.commit(
        "lab/arm",
        "dash",
        &[
            ("-p/worlds/a.wbt", &world_text("dash")),
            ("--/worlds/a.wbt", &world_text("two")),
        ],
    );
    forge.commit("group/team/leg", "main", &[("worlds/a.wbt", &world_text("gitlab"))]);
    let file = format!("file:{}", forge.path().display());
    let mirrors =
        serde_json::json!({"https://github.com/": file, "https://gitlab.lab/": file, "https://gitea.lab:3000/": file});
    let allowed = serde_json::json!(["https://github.com/lab", "https://gitlab.lab", "https://gitea.lab:3000"]);
    let builder = simulation_server(&webots.path(), forge.path(), 2);
    let server = builder
        .set("gitMirrors", mirrors)
        .set("allowedRepositories", allowed)
        .start()
        .await;
    let table = [
        ("https://github.com/lab/arm/blob/main/worlds/a.wbt".to_owned(), "newer"),
        ("https://github.com/lab/arm/tree/main/worlds/a.wbt".to_owned(), "newer"),
        (
            "https://GitHub.com/lab/arm/blob/v1.0/worlds/a.wbt".to_owned(),
            "root of main",
        ),
        (
            format!("https://github.com/lab/arm/blob/{first}/worlds/a.wbt"),
            "root of main",
        ),
        ("https://github.com/lab/arm/blob/main//worlds/a.wbt".to_owned(), "newer"),
        (
            "https://github.com/lab/arm/blob/main/worlds/a.wbt?raw=true".to_owned(),
            "newer",
        ),
        (
            "https://www.github.com/lab/arm.git/blob/main/worlds/a.wbt#L5".to_owned(),
            "newer",
        ),
        (
            "https://github.com/lab/arm/blob/main/p%20q/worlds/b%20%C3%A9.wbt".to_owned(),
            "spaces",
        ),
        (
            "https://github.com/lab/arm/blob/feature/arm/sub/worlds/a.wbt".to_owned(),
            "slashes",
        ),
        (
            "https://github.com/lab/arm/blob/q'%22$(touch$%7BIFS%7Dpwned)%60id%60/worlds/a.wbt".to_owned(),
            "quotes",
        ),
        (
            "https://github.com/lab/arm/blob/dash/-p/worlds/a.wbt".to_owned(),
            "dash",
        ),
        ("https://github.com/lab/arm/blob/dash/--/worlds/a.wbt".to_owned(), "two"),
        (
            "https://gitlab.lab/group/team/leg/-/blob/main/worlds/a.wbt".to_owned(),
            "gitlab",
        ),
        (
            "https://gitea.lab:3000/lab/arm/src/branch/feature/arm/sub/worlds/a.wbt".to_owned(),
            "slashes",
        ),
        (
            "https://gitea.lab:3000/lab/arm/src/tag/v1.0/worlds/a.wbt".to_owned(),
            "root of main",
        ),
        (
            format!("https://gitea.lab:3000/lab/arm/src/commit/{first}/worlds/a.wbt"),
            "root of main",
        ),
    ];
    for (url, mark) in table {
        is_told(&server, &url, &format!("opened [{mark}]")).await;
    }
    assert!(
        !server.folder.join("pwned").exists() && !Path::new("pwned").exists(),
        "a name was run"
    );
    assert!(server.log().contains("is for Webots R2025a"));
}

#[actix_rt::test]
async fn a_world_runs_only_where_its_repository_is_allowed() {
    let forge = Forge::with_arm();
    let webots = reader();
    for name in ["lab-evil/arm", "lab/secret"] {
        forge.commit(name, "main", &[("worlds/a.wbt", &world_text(name))]);
    }
    let builder = simulation_server(&webots.path(), forge.path(), 2);
    let blocked = serde_json::json!(["https://github.com/lab/secret"]);
    let server = builder.set("blockedRepositories", blocked).start().await;
    let end = "blob/main/worlds/a.wbt";
    let not_allowed = "Docker not enabled: cannot host simulations from repositories outside of those that this simulation server allows";
    let is_blocked = "Cannot run simulation from blocked repository";
    let table = [
        (format!("https://github.com/lab/arm/{end}"), "opened [WorldInfo"),
        (format!("https://github.com/lab-evil/arm/{end}"), not_allowed),
        (format!("https://github.com//lab-evil//arm/{end}"), not_allowed),
        (format!("https://github.com.evil.org/lab/arm/{end}"), not_allowed),
        (format!("https://evil.org/github.com/lab/{end}"), not_allowed),
        (format!("https://github.com/LAB/Secret.git/{end}"), is_blocked),
        (
            "https://github.com/lab/secret/src/branch/main/worlds/a.wbt".to_owned(),
            is_blocked,
        ),
        (
            "https://github.com/lab/secret/-/blob/main/worlds/a.wbt".to_owned(),
            is_blocked,
        ),
        (
            format!("https://github.com/lab/%2e%2e/lab-evil/arm/{end}"),
            "https://github.com/lab-evil/arm is not one of them",
        ),
    ];
    for (url, words) in table {
        is_told(&server, &url, words).await;
    }
}

#[actix_rt::test]
async fn what_is_not_there_or_no_world_is_told_in_words() {
    let forge = Forge::with_arm();
    let webots = reader();
    let work = forge.work_tree("lab/arm", "main");
    for (target, link) in [
        ("/etc/passwd", "passwd.wbt"),
        ("../../../../outside.wbt", "outside.wbt"),
        ("a.wbt", "inside.wbt"),
    ] {
        std::os::unix::fs::symlink(target, work.join("worlds").join(link)).unwrap();
    }
    for (name, text) in [
        ("page", "<html>"),
        ("empty", ""),
        ("windows", "#VRML_SIM R2023b utf8\r\nopened\r\n"),
    ] {
        std::fs::write(work.join("worlds").join(name).with_extension("wbt"), text).unwrap();
    }
    std::fs::create_dir_all(work.join("real/worlds")).unwrap();
    std::fs::write(work.join("real/worlds/b.wbt"), world_text("linked")).unwrap();
    std::fs::create_dir_all(work.join("far/worlds")).unwrap();
    for (target, link) in [
        ("real", "project"),
        ("/etc", "etc"),
        ("../../real/worlds/b.wbt", "far/worlds/b.wbt"),
    ] {
        std::os::unix::fs::symlink(target, work.join(link)).unwrap();
    }
    forge.commit_work_tree("lab/arm", "main");
    let tip = git(&forge.path().join("lab/arm"), &["rev-parse", "main"]);
    let server = simulation_server(&webots.path(), forge.path(), 2).start().await;
    std::fs::write(server.folder.join("outside.wbt"), world_text("outside")).unwrap();
    let none = "0123456789012345678901234567890123456789";
    let table = [
        (
            world("lab/none", "main", "worlds/a.wbt"),
            "https://github.com/lab/none does not exist or is not public",
        ),
        (
            arm_at("none"),
            "https://github.com/lab/arm has no branch, tag or commit called \"none\"",
        ),
        (arm_at(none), "is in no branch or tag of https://github.com/lab/arm"),
        (
            world("lab/arm", "main", "worlds/none.wbt"),
            "worlds/none.wbt in main does not exist",
        ),
        (
            world("lab/arm", "main", "p/worlds/a.wbt"),
            "p/worlds/a.wbt in main does not exist",
        ),
        (
            world("lab/arm", "main", "worlds/passwd.wbt"),
            "passwd.wbt leads out of its repository",
        ),
        (world("lab/arm", "main", "worlds/outside.wbt"), "outside.wbt"),
        (
            world("lab/arm", "main", "worlds/page.wbt"),
            "page.wbt is no world file: its first line is \"‹html›\"",
        ),
        (
            world("lab/arm", "main", "worlds/empty.wbt"),
            "empty.wbt is no world file",
        ),
        (world("lab/arm", "main", "worlds/windows.wbt"), "[opened"),
        (world("lab/arm", "main", "worlds/inside.wbt"), "opened [WorldInfo"),
        (
            world("lab/arm", "main", "project/worlds/b.wbt"),
            "project/worlds/b.wbt in main does not exist",
        ),
        (
            world("lab/arm", "main", "etc/worlds/b.wbt"),
            "etc/worlds/b.wbt in main does not exist",
        ),
        (world("lab/arm", "main", "far/worlds/b.wbt"), "b.wbt does not exist"),
        (arm_at(&tip[..9]), "has no branch, tag or commit called"),
    ];
    for (url, words) in table {
        let told = outcome(&server, &url).await;
        assert!(told.contains(words) && !told.contains("root:"), "{url}: {told}");
        nothing_left(&server, 2).await;
    }
}

#[actix_rt::test]
async fn a_repository_can_run_nothing() {
    let forge = Forge::with_arm();
    let webots = reader();
    let trap = tempfile::tempdir().unwrap();
    let touch = |name: &str| format!("touch {}", trap.path().join(name).display());
    let work = forge.work_tree("lab/arm", "main");
    std::fs::write(work.join(".gitattributes"), "* filter=evil diff=evil\n").unwrap();
    std::fs::write(
        work.join(".gitmodules"),
        format!(
            "[submodule \"m\"]\n\tpath = m\n\turl = ext::sh -c {}\n",
            touch("m").replace(' ', "% ")
        ),
    )
    .unwrap();
    git(&work, &["add", "--all"]);
    git(
        &work,
        &[
            "update-index",
            "--add",
            "--cacheinfo",
            "160000,0123456789012345678901234567890123456789,m",
        ],
    );
    forge.commit_work_tree("lab/arm", "main");
    // Hooks and filters in the bare repository of the forge.
    let bare = forge.path().join("lab/arm");
    std::fs::create_dir(bare.join("hooks")).unwrap();
    for hook in ["post-checkout", "pre-auto-gc", "reference-transaction"] {
        std::fs::write(bare.join("hooks").join(hook), format!("#!/bin/sh\n{}\n", touch(hook))).unwrap();
        git(&bare, &["config", "filter.evil.smudge", &touch("smudge")]);
    }
    // Settings of the user that runs the server.
    let home = trap.path().join("home");
    std::fs::create_dir_all(home.join(".config/git")).unwrap();
    std::fs::write(home.join(".config/git/attributes"), "*.wbt text eol=crlf\n").unwrap();
    std::fs::write(
        home.join(".gitconfig"),
        format!(
            "[filter \"evil\"]\n\tsmudge = {}\n[core]\n\tsshCommand = false\n",
            touch("home")
        ),
    )
    .unwrap();
    let builder = simulation_server(&webots.path(), forge.path(), 2).env("HOME", home.to_str().unwrap());
    let server = builder
        .env("XDG_CONFIG_HOME", home.join(".config").to_str().unwrap())
        .start()
        .await;
    is_told(
        &server,
        &arm(),
        "opened [WorldInfo { title \"Test\" basicTimeStep 32 }]",
    )
    .await;
    let left: Vec<_> = std::fs::read_dir(trap.path())
        .unwrap()
        .flatten()
        .map(|entry| entry.file_name())
        .collect();
    assert_eq!(left, ["home"]);
}

#[actix_rt::test]
async fn equal_checkouts_are_joined_and_cached() {
    let wrapper = Wrapper::git("case \"$*\" in *fetch*) sleep 0.7;; esac");
    let server = server_of(reader(), 6).env("PATH", &wrapper.path()).start().await;
    let forge = server.forge();
    let all = join_all((0..5).map(|_| async { outcome(&server, &arm()).await })).await;
    assert!(all.iter().all(|told| told.contains("opened [WorldInfo")), "{all:?}");
    let count = |what: &str| {
        wrapper
            .calls()
            .iter()
            .filter(|call| call.split(' ').any(|word| word == what))
            .count()
    };
    assert_eq!(
        (count("ls-remote"), count("init"), count("fetch"), count("checkout")),
        (1, 1, 1, 5)
    );
    outcome(&server, &arm()).await;
    assert_eq!((count("ls-remote"), count("fetch"), count("checkout")), (2, 1, 6));
    // Only changes are fetched.
    forge.commit_noise("lab/arm", 1 << 20);
    outcome(&server, &arm()).await;
    let before = size_of(&server.folder.join("cache/git"));
    forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("changed"))]);
    is_told(&server, &arm(), "opened [changed]").await;
    let grown = size_of(&server.folder.join("cache/git")) - before;
    assert!(before > 1 << 20 && grown < 20_000, "{grown} bytes were fetched");
}

#[actix_rt::test]
async fn progress_moves_in_percent() {
    let wrapper = Wrapper::git(
        "case \"$*\" in *fetch*) for n in 10 35 60 85; do for again in 1 2 3 4; do printf 'Receiving objects: %s%% (1/2)\\r' $n >&2; sleep 0.25; done; done;; esac",
    );
    let server = server_of(reader(), 1).env("PATH", &wrapper.path()).start().await;
    let mut client = Client::start(&server, &arm()).await;
    // Webots' page reads only one digit before and one after the slash of a step.
    let told = r#"progress: {"step":"search","text":"looking for https://github.com/lab/arm"}"#;
    client.until(told).await;
    client.until("loading: Step 1/9 : looking for").await;
    for (step, percent) in [(2, 10), (3, 35), (5, 60), (6, 85)] {
        let words = format!("fetching https://github.com/lab/arm: Receiving objects: {percent}%");
        let told = format!(r#"progress: {{"step":"fetch","percent":{percent},"text":"{words}"#);
        client.until(&told).await;
        client.until(&format!("loading: Step {step}/9 : {words}")).await;
    }
    client.until(r#"progress: {"step":"write","#).await;
    client.until("loading: Step 8/9 : checking main out").await;
    client
        .until(r#"progress: {"step":"done","text":"checkout done"}"#)
        .await;
    assert_eq!(client.until("").await, "loading: checkout done");
    client.until(r#"progress: {"step":"launch","#).await;
    client.until("loading: webots").await;
}

#[actix_rt::test]
async fn a_kill_in_the_middle_of_a_fetch_harms_no_later_start() {
    let forge = Forge::with_arm();
    let webots = reader();
    forge.commit_noise("lab/arm", 3 << 20);
    let folder = tempfile::tempdir().unwrap();
    let start = || simulation_server(&webots.path(), forge.path(), 2).folder(folder.path());
    // git stops after half a pack. The line is repeated because clients receive only the newest of lines that follow
    // closely, and the processes that git has started may still print some.
    let slow = Wrapper::git(
        "case \"$*\" in *fetch*) \"$REAL\" \"$@\" & sleep 0.03; kill -STOP $!; \
         while echo 'halted: 50%' >&2; do sleep 0.2; done; exit;; esac",
    );
    for victim in ["git", "server"] {
        let mut server = start().env("PATH", &slow.path()).start().await;
        let mut client = Client::start(&server, &arm()).await;
        client
            .until("loading: Step 2/9 : fetching https://github.com/lab/arm: halted")
            .await;
        if victim == "git" {
            let marked = instances_below(folder.path());
            let leads = |pid: i32| nix::unistd::getpgid(Some(Pid::from_raw(pid))) == Ok(Pid::from_raw(pid));
            let fetch = marked
                .iter()
                .find(|one| one.1.contains("fetch") && leads(one.0))
                .unwrap();
            kill(Pid::from_raw(fetch.0), Signal::SIGKILL).unwrap();
            let told = client.until("loading: Error:").await;
            assert!(told.contains("git fetch was ended by the signal SIGKILL"), "{told}");
            nothing_left(&server, 2).await;
        }
        server.signal(Signal::SIGKILL);
        server.ended().await;
        until("git has ended", async || instances_below(folder.path()).is_empty()).await;
        let server = start().start().await;
        is_told(&server, &arm(), "opened [WorldInfo").await;
        let is_whole = async || !cached(&server).iter().any(|path| has_half_a_pack(path));
        until("the half of a pack is gone", is_whole).await;
        std::fs::remove_dir_all(folder.path().join("cache/git")).unwrap();
    }
}

fn has_half_a_pack(repository: &Path) -> bool {
    std::fs::read_dir(repository)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .any(|path| {
            path.file_name().unwrap().to_string_lossy().starts_with("tmp_") || (path.is_dir() && has_half_a_pack(&path))
        })
}

#[actix_rt::test]
async fn a_controller_is_reset_and_nothing_else() {
    let builder = demo_server(1);
    builder
        .forge()
        .commit("lab/arm", "main", &[("protos/p.txt", "original")]);
    let server = builder.start().await;
    let mut client = Client::ready(&server).await;
    let project = instance_folders(&server.folder)[0].join("project");
    let file = project.join("controllers/c/c.py");
    std::fs::write(&file, "changed").unwrap();
    assert_eq!(client.reset("c/c.py").await, "reset controller: c/c.py");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "print('original')\n");
    std::fs::remove_file(&file).unwrap();
    assert_eq!(client.reset("c/c.py").await, "reset controller: c/c.py");
    assert!(file.is_file());
    std::fs::write(project.join("protos/p.txt"), "changed").unwrap();
    let names = [
        "../protos/p.txt",
        "c/../../protos/p.txt",
        "/etc/passwd",
        "c/none.py",
        "c.py",
        "",
        "c/",
    ];
    for name in names.into_iter().chain(["c/c.py\0", ":/protos/p.txt", "*/c.py"]) {
        let answer = client.reset(name).await;
        assert!(
            answer.ends_with("is no file below the project's controllers folder"),
            "{name:?}: {answer}"
        );
    }
    assert_eq!(
        std::fs::read_to_string(project.join("protos/p.txt")).unwrap(),
        "changed"
    );
}

#[actix_rt::test]
async fn files_above_a_project_are_there_without_other_folders() {
    let forge = Forge::new();
    let webots = Webots::script(
        "for last; do :; done\ncd \"$(dirname \"$last\")/../../..\"\necho \"files [$(find . -type f | sort | tr '\\n' ' ')]\"\nexit 1",
    );
    let files = [
        "top.proto",
        "a/mid.proto",
        "a/p q/worlds/a.wbt",
        "a/p q/protos/p.proto",
        "a/other/no.proto",
        "b/no.proto",
    ];
    let text = world_text("above");
    forge.commit("lab/arm", "main", &files.map(|file| (file, text.as_str())));
    let server = simulation_server(&webots.path(), forge.path(), 1).start().await;
    let told = outcome(&server, &world("lab/arm", "main", "a/p%20q/worlds/a.wbt")).await;
    let expected = "files [./a/mid.proto ./a/p q/protos/p.proto ./a/p q/worlds/a.wbt ./top.proto ]";
    assert!(told.contains(expected), "{told}");
}
