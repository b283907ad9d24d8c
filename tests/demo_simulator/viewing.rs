//! Each message of a viewer, and what it hears.

use super::simulator::{MODEL, MOTION, Simulator, Start, WORLD, project, small_project};
use super::viewer::time_of;

async fn paused() -> (tempfile::TempDir, Simulator) {
    started_with(&[]).await
}

async fn started_with(arguments: &[&str]) -> (tempfile::TempDir, Simulator) {
    let other = MODEL.replace("mover", "other mover");
    let project = project(&[
        ("a.wbt", WORLD),
        ("a.x3d", MODEL),
        ("a.motion.json", MOTION),
        ("b.wbt", WORLD),
        ("b.x3d", &other),
        ("b.motion.json", MOTION),
    ]);
    let start = Start::paused(&project.path().join("worlds/a.wbt"));
    (project, start.arguments(arguments).playing().await)
}

#[tokio::test]
async fn nothing_is_said_before_the_first_message_and_then_the_whole_scene() {
    let (_project, simulator) = paused().await;
    for first in ["x3d", "w3d", "x3d;broadcast", "w3d;broadcast"] {
        let mut viewer = simulator.viewer().await;
        viewer.hears_nothing().await;
        viewer.say(first).await;
        assert_eq!(viewer.hear().await, "world:worlds/a.wbt:worlds/a.wbt;worlds/b.wbt");
        let model = viewer.hear().await;
        assert!(model.starts_with("model:<?xml version=\"1.0\" encoding=\"UTF-8\"?><X3D>"), "{model}");
        assert!(model.contains(r#"<Robot id="n6" name="mover" translation="1 2 0" rotation="0 0 1 0"/>"#), "{model}");
        assert_eq!(
            viewer.hear().await,
            r#"application/json:{"time":0,"updates":[{"id":6,"translation":"1 2 0","rotation":"0 0 1 0"}]}"#
        );
        viewer.hears(&["scene load completed", "pause: 0"]).await;
        viewer.hears_nothing().await;
    }
}

#[tokio::test]
async fn pause_is_answered_to_the_one_who_asked() {
    let (_project, mut simulator) = paused().await;
    let (mut one, mut other) = (simulator.spectator().await, simulator.spectator().await);
    one.say("pause").await;
    one.hears(&["paused by client"]).await;
    simulator.prints(&["pause"]).await;
    other.hears_nothing().await;
}

#[tokio::test]
async fn a_step_moves_time_for_all_and_is_answered_to_the_one_who_asked() {
    let (_project, mut simulator) = paused().await;
    let (mut one, mut other) = (simulator.spectator().await, simulator.spectator().await);
    for time in ["10", "20"] {
        one.say("step").await;
        let update = one.hear().await;
        assert!(
            update.starts_with(&format!("application/json:{{\"time\":{time},\"updates\":[{{\"id\":6,")),
            "{update}"
        );
        one.hears(&["paused by client"]).await;
        simulator.prints(&["step", "pause"]).await;
        assert_eq!(other.hear().await, update);
        other.hears_nothing().await;
    }
}

#[tokio::test]
async fn real_time_and_fast_run_until_paused_and_later_viewers_hear_which() {
    for mode in ["real-time", "fast"] {
        let (_project, mut simulator) = paused().await;
        let mut viewer = simulator.spectator().await;
        viewer.say(&format!("{mode}:-1")).await;
        viewer.hears(&[mode, "application/json:", "application/json:", "application/json:"]).await;
        let mut late = simulator.viewer().await;
        late.say("w3d;broadcast").await;
        assert_eq!(late.hears_scene().await, mode);
        viewer.say("pause").await;
        let times: Vec<f64> =
            viewer.hears_after_updates("paused by client").await.iter().map(|text| time_of(text)).collect();
        assert!(times.is_sorted_by(|earlier, later| earlier < later), "{times:?}");
        viewer.hears_nothing().await;
        simulator.prints(&[mode, "pause"]).await;
    }
}

#[tokio::test]
async fn a_run_with_a_timeout_pauses_by_itself_and_tells_all() {
    let (_project, mut simulator) = paused().await;
    let (mut one, mut other) = (simulator.spectator().await, simulator.spectator().await);
    for (command, mode, state) in [("real-time:95", "real-time", "pause: 100"), ("fast:500", "fast", "pause: 600")] {
        one.say(command).await;
        one.hears(&[mode]).await;
        let updates = one.hears_after_updates(state).await;
        assert_eq!(updates.last().map(|update| format!("pause: {}", time_of(update))), Some(state.to_owned()));
        other.hears_after_updates(state).await;
        simulator.prints(&[mode, "pause"]).await;
    }
}

#[tokio::test]
async fn a_timeout_changes_when_a_run_pauses() {
    let (_project, mut simulator) = paused().await;
    let mut viewer = simulator.spectator().await;
    viewer.say("real-time:-1").await;
    viewer.hears(&["real-time", "application/json:"]).await;
    viewer.say("timeout:0").await;
    loop {
        let heard = viewer.hear().await;
        if heard.starts_with("pause: ") {
            break;
        }
    }
    simulator.prints(&["real-time", "pause"]).await;
}

#[tokio::test]
async fn a_viewer_that_does_not_only_look_on_pauses_a_simulation_that_runs_by_itself() {
    let (_project, mut simulator) = started_with(&["--mode=realtime"]).await;
    let mut spectator = simulator.spectator().await;
    spectator.hears(&["application/json:", "application/json:"]).await;
    let mut viewer = simulator.viewer().await;
    viewer.say("w3d").await;
    simulator.prints(&["pause"]).await;
    while !spectator.hear().await.starts_with("pause: ") {}
    spectator.hears_nothing().await;
}

#[tokio::test]
async fn a_reset_goes_back_to_the_start_for_all() {
    let (_project, mut simulator) = paused().await;
    let (mut one, mut other) = (simulator.spectator().await, simulator.spectator().await);
    one.say("step").await;
    one.hears(&["application/json:{\"time\":10,", "paused by client"]).await;
    other.hears(&["application/json:{\"time\":10,"]).await;
    one.say("reset").await;
    for viewer in [&mut one, &mut other] {
        assert_eq!(
            viewer.hear().await,
            r#"application/json:{"time":0,"updates":[{"id":6,"translation":"1 2 0","rotation":"0 0 1 0"}]}"#
        );
        viewer.hears(&["reset finished"]).await;
        viewer.hears_nothing().await;
    }
    simulator.prints(&["step", "pause", "reset"]).await;
    one.say("step").await;
    one.hears(&["application/json:{\"time\":10,"]).await;
}

#[tokio::test]
async fn a_reset_forgets_the_timeout_and_keeps_the_mode() {
    let (_project, simulator) = paused().await;
    let mut viewer = simulator.spectator().await;
    viewer.say("real-time:60000").await;
    viewer.hears(&["real-time", "application/json:"]).await;
    viewer.say("reset").await;
    while viewer.hear().await != "reset finished" {}
    viewer.hears(&["application/json:", "application/json:"]).await;
}

#[tokio::test]
async fn reload_and_load_show_a_world_again_without_the_state() {
    let (project, mut simulator) = paused().await;
    let (mut one, mut other) = (simulator.spectator().await, simulator.spectator().await);
    one.say("step").await;
    one.hears(&["application/json:", "paused by client"]).await;
    other.hears(&["application/json:"]).await;
    let changed = MODEL.replace("mover", "changed mover");
    std::fs::write(project.path().join("worlds/a.x3d"), changed).unwrap();
    for (command, world, robot) in [
        ("reload", "worlds/a.wbt", "changed mover"),
        ("revert", "worlds/a.wbt", "changed mover"),
        ("load:b.wbt", "worlds/b.wbt", "other mover"),
        ("load:../worlds/a.wbt", "worlds/a.wbt", "changed mover"),
    ] {
        one.say(command).await;
        for viewer in [&mut one, &mut other] {
            viewer.hears(&["delete world", "loading:Reading world file :0"]).await;
            viewer.hears(&["loading:Parsing world:100", "loading:Finalizing nodes:100"]).await;
            viewer.hears(&[&format!("world:{world}:")]).await;
            let model = viewer.hear().await;
            assert!(model.contains(&format!("name=\"{robot}\"")), "{command}: {model}");
            viewer.hears(&["application/json:{\"time\":0,", "scene load completed"]).await;
            viewer.hears_nothing().await;
        }
    }
    simulator.prints(&["step", "pause"]).await;
}

#[tokio::test]
async fn what_makes_no_sense_is_ignored_and_logged() {
    let (_project, mut simulator) = started_with(&["--stderr"]).await;
    let mut viewer = simulator.spectator().await;
    for (text, complaint) in [
        ("dance", "Unsupported message: \"dance\"."),
        ("", "Unsupported message: \"\"."),
        ("pause ", "Unsupported message: \"pause \"."),
        ("fast:NaN", "Unsupported message: \"fast:NaN\"."),
        ("real-time:", "Unsupported message: \"real-time:\"."),
        ("real-time:soon", "Unsupported message: \"real-time:soon\"."),
        ("load:missing.wbt", "there is no world \"missing.wbt\"."),
        ("load:../../etc/passwd", "there is no world \"../../etc/passwd\"."),
        ("load:a.x3d", "there is no world \"a.x3d\"."),
        ("load:..", "there is no world \"..\"."),
        ("mjpeg: 800x600", "this simulator renders no pictures."),
    ] {
        viewer.say(text).await;
        simulator.has_printed(&format!("stderr: ERROR: Streaming server: {complaint}")).await;
    }
    viewer.say("robot:{\"name\":\"mover\",\"message\":\"hello\"}").await;
    viewer.say("pause").await;
    viewer.hears(&["paused by client"]).await;
    simulator.prints(&["pause"]).await;
    assert!(!simulator.printed().contains("hello"));
}

#[tokio::test]
async fn without_stream_clients_are_accepted_and_ignored() {
    let project = small_project();
    let start = Start::with(&["--batch", "--mode=pause", "--stdout", "--port=21234"]);
    let simulator = start.world(&project.path().join("worlds/a.wbt")).listening().await;
    let mut viewer = simulator.viewer().await;
    viewer.say("w3d").await;
    viewer.say("pause").await;
    viewer.hears_nothing().await;
}
