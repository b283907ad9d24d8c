//! The command line, from outside.

use super::simulator::{SMALL_WORLD, Start, project};

#[tokio::test]
async fn a_bad_option_ends_it_with_a_message_and_1() {
    for arguments in [
        vec!["--nonsense", "w.wbt"],
        vec!["--stream=foo", "w.wbt"],
        vec!["--port=0", "w.wbt"],
        vec!["--mode=slow", "w.wbt"],
        vec!["w.wbt", "--heartbeat=x"],
        vec![],
    ] {
        let mut simulator = Start::with(&arguments).spawn();
        assert_eq!(simulator.end().await.code(), Some(1), "{arguments:?}");
        simulator.has_printed("stderr: webots: ").await;
        simulator.has_printed("stderr: Try 'webots --help' for more information.").await;
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
    let project = project(&[("a.wbt", SMALL_WORLD)]);
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
