//! Each message of a viewer, and what it hears.

use super::simulator::{MODEL, MOTION, Simulator, Start, WORLD, project};
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
