//! When Webots becomes ready, on which display, and what happens if it does not become ready.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::ends::line;
use super::opened::world_text;
use super::scene::nothing_left;
use crate::support::stopwatch::Stopwatch;
use crate::support::wrapper::Wrapper;
use crate::support::{
    Client, DEMO, Forge, Server, Webots, arm, demo_server, display, instance_folders_in, is_told, outcome, programs,
    server_of, simulation_server, until, world,
};

#[actix_rt::test]
async fn a_launch_that_never_listens_ends_with_its_last_words() {
    let webots = Webots::script("for n in $(seq 30); do echo \"line $n\"; done; sleep 1000 & wait");
    let server = server_of(webots, 1).set("timing.launch", 3).start().await;
    let mut client = Client::start(&server, &arm()).await;
    let told = client.until("loading: Error:").await;
    assert!(
        told.contains("Webots did not become ready within") && told.contains("line 11 | "),
        "{told}"
    );
    assert!(told.contains("| line 30") && !told.contains("line 10 "), "{told}");
    nothing_left(&server, 1).await;
}

#[actix_rt::test]
async fn a_webots_that_hangs_is_told_and_ended() {
    // A simulator without heartbeat.
    let webots = Webots::script(&format!(
        "args=()\nfor one; do case $one in --heartbeat*) ;; *) args+=(\"$one\");; esac; done\n{DEMO} \"${{args[@]}}\" & wait"
    ));
    let builder = server_of(webots, 1).set("timing.heartbeat", 0.5);
    let server = builder.set("hangLimit", 1.1).start().await;
    let stopwatch = Stopwatch::start();
    let begun = stopwatch.lap();
    let mut client = Client::ready(&server).await;
    let words = "loading: Webots has given no sign of life for ";
    let told = client.until(words).await;
    let seconds = |words: &str| words.split(' ').next().and_then(|number| number.parse::<u64>().ok());
    // Later if the machine has delayed the server.
    let late = || begun.held_up().as_secs_f64().ceil() as u64;
    // Six heartbeats, and the time until the next check.
    assert!(
        told.strip_prefix(words)
            .and_then(seconds)
            .is_some_and(|seconds| (3..=3 + late()).contains(&seconds)),
        "{told}"
    );
    let told = client.until("loading: Error:").await;
    let rest = told.split_once("Webots gave no sign of life for ");
    assert!(
        rest.and_then(|(_, rest)| seconds(rest))
            .is_some_and(|seconds| (4..=4 + late()).contains(&seconds)),
        "{told}"
    );
    assert!(begun.wall() > Duration::from_secs(4), "hangLimit was not waited for");
    assert_eq!(line(&server, client.id()).await[10], "hung");
    assert_eq!(client.closed().await, Some(1000));
    nothing_left(&server, 1).await;
}

#[actix_rt::test]
async fn webots_is_given_the_documented_command_line_and_a_display() {
    let forge = Forge::with_arm();
    let webots = Webots::script("echo \"on [$DISPLAY]: $*\"\nexit 1");
    let hidden = "--minimize --no-rendering ";
    // The configured display, else that of the server's environment, else `:0`.
    for (configured, environment, display, mode, hidden, stream) in [
        (Some(":57"), "export DISPLAY=:58", ":57", "x3d", hidden, "--stream"),
        (None, "export DISPLAY=:58", ":58", "w3d", hidden, "--stream"),
        (None, "export DISPLAY=", ":0", "mjpeg", "", "--stream=mjpeg"),
        (None, "unset DISPLAY", ":0", "x3d", hidden, "--stream"),
    ] {
        let builder = simulation_server(&webots.path(), forge.path(), 1).before(environment);
        let server = builder.set("display", configured).start().await;
        let mut client = Client::connect(&server.websocket("/client")).await;
        client
            .send(&serde_json::json!({"start": {"url": arm(), "mode": mode}}).to_string())
            .await;
        let told = client.until("loading: Error:").await;
        let port = server.port + 1;
        let words = format!("{hidden}--port={port} --heartbeat=5000 {stream} worlds/a.wbt");
        assert!(
            told.contains(&format!("on [{display}]: --batch --mode=pause {words}")),
            "{told}"
        );
    }
}

#[actix_rt::test]
async fn paths_may_have_spaces_and_quotes() {
    needs!("Xvfb");
    let _alone = display::alone().await;
    let forge = Forge::new();
    let folder = tempfile::tempdir().unwrap();
    forge.commit(
        "lab/arm",
        "main",
        &[("p q's/worlds/b  \"c\".wbt", &world_text("opened"))],
    );
    let script = "for last; do :; done\ntest -S /tmp/.X11-unix/X${DISPLAY#:} && echo 'with a display'\necho \"$PWD [$(sed -n 2p \"$last\")] $last\"\nexit 1";
    let reader = Webots::script(script);
    let home = folder.path().join("my \"own\" webots");
    std::fs::create_dir(&home).unwrap();
    let program = home.join("webots");
    std::fs::copy(reader.path(), &program).unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    for xvfb in [false, true] {
        let builder = simulation_server(&program, forge.path(), 1)
            .set("cacheDir", at("the cache's"))
            .set("xvfb", xvfb);
        let server = builder.set("logDir", at("the log's")).start().await;
        let told = outcome(&server, &world("lab/arm", "main", "p%20q's/worlds/b%20%20%22c%22.wbt")).await;
        assert!(!xvfb || told.contains("with a display | "), "{told}");
        assert!(told.contains(" p q's [opened] p q's/worlds/b  \"c\".wbt"), "{told}");
        assert!(!told.contains("the cache's"), "{told}");
        let ended = PathBuf::from(at("the log's")).join("simulation/ended");
        let kept = || {
            std::fs::read_dir(&ended)
                .into_iter()
                .flatten()
                .flatten()
                .map(|file| file.path())
        };
        let has_it = |log: &PathBuf| std::fs::read_to_string(log).is_ok_and(|text| text.contains("[opened]"));
        until("its output is kept", async || {
            kept().filter(has_it).count() == 1 + usize::from(xvfb)
        })
        .await;
        until("its folder is gone", async || {
            instance_folders_in(Path::new(&at("the cache's"))).is_empty()
        })
        .await;
    }
}

/// The display that a Webots has printed.
async fn display_of(server: &Server, client: &Client) -> String {
    let printed = || {
        let text = std::fs::read_to_string(server.output_file(client)).unwrap_or_default();
        text.split_inclusive('\n')
            .find_map(|line| Some(line.strip_prefix("display ")?.strip_suffix('\n')?.to_owned()))
    };
    until("the display is printed", async || printed().is_some()).await;
    printed().unwrap()
}

#[actix_rt::test]
async fn each_webots_gets_a_virtual_display_of_its_own() {
    needs!("Xvfb");
    let _alone = display::alone().await;
    // It prints its display, and fails if there is none.
    let webots = Webots::script(&format!(
        "test -S /tmp/.X11-unix/X${{DISPLAY#:}} || exit 9\necho \"display $DISPLAY\"\n{DEMO} \"$@\" & wait"
    ));
    // In sandboxes, all displays have the same number.
    let server = server_of(webots, 2)
        .set("xvfb", true)
        .set("isolation", "none")
        .start()
        .await;
    let one = Client::ready(&server).await;
    let other = Client::ready(&server).await;
    let first = display_of(&server, &one).await;
    let second = display_of(&server, &other).await;
    assert_ne!(first, second);
    one.leave().await;
    other.leave().await;
    nothing_left(&server, 2).await;
    for name in [first, second] {
        assert!(!PathBuf::from(format!("/tmp/.X{}-lock", name.trim_start_matches(':'))).exists());
    }
}

#[actix_rt::test]
async fn a_virtual_display_that_does_not_start_is_told() {
    needs!("bwrap");
    let forge = Forge::with_arm();
    let webots = Webots::launcher();
    let without = programs(&["git", "bash", "env", "sh", "rm", "prlimit"]);
    let server = demo_server(1)
        .set("xvfb", true)
        .env("PATH", without.path().to_str().unwrap())
        .start()
        .await;
    is_told(&server, &arm(), "(xvfb), but has no Xvfb").await;
    let xvfb = Wrapper::of("Xvfb", "echo 'first words' >&2; echo 'no screens found' >&2; exit 1");
    for level in ["none", "sandbox"] {
        let builder = simulation_server(&webots.path(), forge.path(), 1)
            .set("xvfb", true)
            .set("isolation", level);
        let server = builder.env("PATH", &xvfb.path()).start().await;
        is_told(
            &server,
            &arm(),
            "The virtual display (Xvfb) can't be started: no screens found",
        )
        .await;
        nothing_left(&server, 1).await;
    }
}
