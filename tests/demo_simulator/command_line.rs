//! The command line, from outside.

use super::simulator::{Start, small_project};

#[tokio::test]
async fn a_bad_command_line_ends_it_with_the_reason_on_one_line_and_1() {
    for (arguments, reason) in [
        (vec!["--nonsense", "w.wbt"], "unexpected argument '--nonsense' found"),
        (vec!["--batch=yes", "w.wbt"], "unexpected value 'yes' for '--batch'"),
        (vec!["--port", "w.wbt"], "equal sign is needed when assigning values to '--port=<PORT>'"),
        (vec!["--port=0", "w.wbt"], "invalid value '0' for '--port=<PORT>': 0 is not in 1..=65535"),
        (vec!["--port=65536", "w.wbt"], "invalid value '65536' for '--port=<PORT>': 65536 is not in 1..=65535"),
        (vec!["--stream=foo", "w.wbt"], "invalid value 'foo' for '--stream[=<STREAM>]': the modes are w3d and x3d"),
        (
            vec!["--mode=slow", "w.wbt"],
            "invalid value 'slow' for '--mode=<MODE>' [possible values: pause, realtime, fast]",
        ),
        (vec!["w.wbt", "--heartbeat=x"], "invalid value 'x' for '--heartbeat[=<HEARTBEAT>]'"),
        (vec!["w.wbt", "--heartbeat=0"], "invalid value '0' for '--heartbeat[=<HEARTBEAT>]'"),
        (vec!["a.wbt", "b.wbt"], "unexpected argument 'b.wbt' found"),
        (vec![], "the following required arguments were not provided: <WORLD>"),
    ] {
        let mut simulator = Start::with(&arguments).spawn();
        assert_eq!(simulator.end().await.code(), Some(1), "{arguments:?}");
        simulator.has_printed(&format!("stderr: webots: {reason}")).await;
        simulator.has_printed("stderr: Try 'webots --help' for more information.").await;
    }
}

#[tokio::test]
async fn pictures_are_refused_at_the_start() {
    let project = small_project();
    let start = Start::with(&["--batch", "--mode=pause", "--port=21234", "--stream=mjpeg"]);
    let mut simulator = start.world(&project.path().join("worlds/a.wbt")).spawn();
    assert_eq!(simulator.end().await.code(), Some(1));
    simulator
        .has_printed(
            "stderr: webots: invalid value 'mjpeg' for '--stream[=<STREAM>]': the demo simulator renders no pictures",
        )
        .await;
}

#[tokio::test]
async fn every_option_of_webots_is_taken_in_any_order() {
    let project = small_project();
    let world = project.path().join("worlds/a.wbt");
    for mode in ["pause", "stop", "realtime", "fast", "run"] {
        let simulator = Start::with(&[world.to_str().unwrap(), "--stdout", "--stream=x3d", "--batch"])
            .argument(&format!("--mode={mode}"))
            .arguments(&["--heartbeat", "--minimize", "--no-rendering", "--fullscreen", "--extern-urls"])
            .arguments(&["--log-performance=f,10", "--stderr", "--port=21234"])
            .playing()
            .await;
        let mut viewer = simulator.viewer().await;
        viewer.say("w3d;broadcast").await;
        let state = viewer.hears_scene().await;
        assert_eq!(state.starts_with("pause: 0"), ["pause", "stop"].contains(&mode), "{mode}: {state}");
        assert_eq!(state == "real-time", mode == "realtime", "{mode}: {state}");
    }
}

#[tokio::test]
async fn questions_are_answered_without_starting_anything() {
    for (argument, answer) in [
        ("--version", "Webots version: R2025a\n"),
        ("--sysinfo", "Number of cores: "),
        ("--help", "stderr: Usage: webots [options] [worldfile]"),
    ] {
        let mut simulator = Start::with(&[argument]).spawn();
        assert_eq!(simulator.end().await.code(), Some(0), "{argument}");
        simulator.has_printed(answer).await;
    }
}

#[tokio::test]
async fn warnings_are_printed_only_with_stderr() {
    let project = small_project();
    let start = || {
        let world = project.path().join("worlds/a.wbt");
        Start::with(&["--mode=pause", "--stream", "--stdout", "--heartbeat=1"]).world(&world)
    };
    let mut quiet = start().listening().await;
    quiet.prints(&["."]).await;
    assert!(!quiet.printed().contains("WARNING"));
    let loud = start().argument("--stderr").listening().await;
    loud.has_printed("stderr: WARNING: Streaming should be used with --batch.").await;
}
