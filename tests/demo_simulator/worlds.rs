//! What clients are shown of a world.

use std::path::{Path, PathBuf};

use quick_xml::Reader;
use quick_xml::events::Event;

use super::simulator::{MODEL, MOTION, Simulator, Start, WORLD, project};

/// The model that the simulator sends.
async fn model(simulator: &Simulator) -> String {
    let mut viewer = simulator.viewer().await;
    viewer.say("w3d").await;
    loop {
        let heard = viewer.hear().await;
        if heard.starts_with("model:") {
            return heard;
        }
    }
}

#[tokio::test]
async fn a_world_that_cannot_be_shown_is_replaced_by_an_empty_one_and_only_stderr_tells() {
    for (files, reason) in [
        (vec![("a.wbt", "")], "the first line must be '#VRML_SIM"),
        (vec![("a.wbt", "WorldInfo { }"), ("a.x3d", MODEL)], "the first line must be '#VRML_SIM"),
        (vec![("a.wbt", "#VRML_SIM utf8\n"), ("a.x3d", MODEL)], "the first line must be '#VRML_SIM"),
        (vec![("a.wbt", "#VRML V2.0 utf8\n"), ("a.x3d", MODEL)], "the first line must be '#VRML_SIM"),
        (vec![("a.wbt", WORLD), ("a.x3d", MODEL), ("a.motion.json", "{")], "the motion of the robots: EOF"),
        (
            vec![("a.wbt", WORLD), ("a.x3d", MODEL), ("a.motion.json", "{\"fps\": 1}")],
            "the motion of the robots: unknown",
        ),
        (vec![("a.wbt", WORLD), ("a.x3d/b", "")], "cannot read '"),
    ] {
        let project = project(&[]);
        let world = project.path().join("worlds/a.wbt");
        for (name, text) in &files {
            let file = world.with_file_name(name);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, text).unwrap();
        }
        let mut quiet = Start::paused(&world).argument("--heartbeat=1").listening().await;
        let model = model(&quiet).await;
        assert!(model.contains("<Viewpoint") && !model.contains("<Solid"), "{files:?}: {model}");
        quiet.prints(&["."]).await;
        assert!(!quiet.printed().contains("stderr"));
        let loud = Start::paused(&world).argument("--stderr").listening().await;
        loud.has_printed(&format!("stderr: ERROR: '{}': {reason}", world.display())).await;
    }
}

#[tokio::test]
async fn headers_of_older_releases_are_taken() {
    for header in ["#VRML_SIM R2023b utf8\r\n", "#VRML_SIM V8.6.2 utf8", "\u{feff}#VRML_SIM R2025a utf8\n"] {
        let project = project(&[("a.wbt", header), ("a.x3d", MODEL)]);
        let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
        assert!(model(&simulator).await.contains("mover"), "{header:?}");
    }
}

#[tokio::test]
async fn the_demo_worlds_have_robots_that_move() {
    for (name, robots) in [("playground.wbt", 3), ("carousel.wbt", 4)] {
        let world = demo_worlds().join(name);
        let simulator = Start::paused(&world).argument("--stderr").playing().await;
        let mut viewer = simulator.viewer().await;
        viewer.say("w3d").await;
        let worlds = viewer.hear().await;
        assert_eq!(worlds, format!("world:worlds/{name}:worlds/carousel.wbt;worlds/playground.wbt"));
        let model = viewer.hear().await;
        assert_eq!(model.matches("<Robot ").count(), robots);
        assert!(model.contains("<Background ") && model.contains("<DirectionalLight "));
        viewer.hears(&["application/json:", "scene load completed", "pause: 0"]).await;
        let mut last = String::new();
        for _ in 0..2 {
            viewer.say("step").await;
            let update = viewer.hear().await;
            assert_eq!(update.matches("\"translation\"").count(), robots, "{update}");
            let poses = update.split_once("updates").unwrap().1.to_owned();
            assert_ne!(poses, last);
            last = poses;
            viewer.hears(&["paused by client"]).await;
        }
        assert!(!simulator.printed().contains("stderr"));
    }
}

fn demo_worlds() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/demo/worlds")
}

/// The robots of a model: name, number of the node, translation, angle about the vertical axis.
fn robots_of_model(model: &str) -> Vec<(String, u64, Vec<f64>, f64)> {
    let numbers = |text: &str| text.split(' ').map(|number| number.parse().unwrap()).collect::<Vec<f64>>();
    let mut reader = Reader::from_str(model);
    let mut robots = Vec::new();
    loop {
        match reader.read_event().unwrap() {
            Event::Eof => return robots,
            Event::Start(tag) | Event::Empty(tag) if tag.name().as_ref() == "Robot" => {
                let attribute = |name: &str| tag.try_get_attribute(name).unwrap().unwrap().value.into_owned();
                let rotation = numbers(&attribute("rotation"));
                assert_eq!(rotation[..3], [0.0, 0.0, 1.0], "robots turn about the vertical axis");
                let id = attribute("id").trim_start_matches('n').parse().unwrap();
                robots.push((attribute("name"), id, numbers(&attribute("translation")), rotation[3]));
            }
            _ => (),
        }
    }
}

#[test]
fn world_model_and_motion_of_the_demo_agree() {
    for name in ["playground", "carousel"] {
        let read =
            |extension: &str| std::fs::read_to_string(demo_worlds().join(name).with_extension(extension)).unwrap();
        let (world, model) = (read("wbt"), read("x3d"));
        let motion: serde_json::Value = serde_json::from_str(&read("motion.json")).unwrap();
        let robots = robots_of_model(&model);
        assert_eq!(robots.len(), motion["robots"].as_object().unwrap().len(), "{name}");
        for (robot, id, translation, angle) in robots {
            let moves = &motion["robots"][&robot];
            assert_eq!(moves["id"], id, "{robot}");
            assert_eq!(serde_json::from_value::<Vec<f64>>(moves["start"].clone()).unwrap(), translation, "{robot}");
            assert_eq!(moves["heading"].as_f64(), Some(angle), "{robot}");
            assert!(world.contains(&format!("Robot {{\n  name \"{robot}\"")), "{robot}");
        }
        for setting in ["basicTimeStep", "FPS"] {
            assert!(world.contains(&format!("{setting} {}\n", motion[setting])), "{name}: {setting}");
            assert!(model.contains(&format!("{setting}=\"{}\"", motion[setting])), "{name}: {setting}");
        }
    }
}

#[tokio::test]
async fn a_world_without_a_model_is_a_small_scene_with_the_files_name_as_its_title() {
    let project = project(&[("<b> & \"c\".wbt", WORLD)]);
    let simulator = Start::paused(&project.path().join("worlds/<b> & \"c\".wbt")).playing().await;
    let model = model(&simulator).await;
    let xml = model.strip_prefix("model:").unwrap();
    assert_eq!(robots_of_model(xml).len(), 1);
    assert!(xml.contains("<X3D><head>") && xml.contains("<Viewpoint "), "it is on one line: {xml}");
    let title = xml.split("title=\"").nth(1).unwrap().split('"').next().unwrap();
    assert_eq!(quick_xml::escape::unescape(title).unwrap(), "<b> & \"c\".wbt");
    let mut viewer = simulator.spectator().await;
    viewer.say("step").await;
    viewer.hears(&["application/json:{\"time\":32,\"updates\":[{\"id\":9,", "paused by client"]).await;
}

#[tokio::test]
async fn a_model_without_motion_stands_still() {
    let project = project(&[("a.wbt", WORLD), ("a.x3d", MODEL)]);
    let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
    let mut viewer = simulator.spectator().await;
    viewer.say("step").await;
    assert_eq!(viewer.hear().await, r#"application/json:{"time":32}"#);
}

#[tokio::test]
async fn steps_have_limits() {
    for (step, time) in [("8", "8"), ("0", "0.1"), ("-5", "0.1"), ("1e300", "10000")] {
        let motion = MOTION.replace("\"basicTimeStep\": 10", &format!("\"basicTimeStep\": {step}"));
        let project = project(&[("a.wbt", WORLD), ("a.x3d", MODEL), ("a.motion.json", &motion)]);
        let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
        let mut viewer = simulator.spectator().await;
        viewer.say("step").await;
        viewer.hears(&[&format!("application/json:{{\"time\":{time},")]).await;
    }
}

#[tokio::test]
async fn a_world_that_is_not_in_a_folder_worlds_has_its_own_folder_for_a_project() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.wbt", "b.WBT", "notes.txt"] {
        std::fs::write(folder.path().join(name), WORLD).unwrap();
    }
    let simulator = Start::paused(&folder.path().join("a.wbt")).playing().await;
    let mut viewer = simulator.viewer().await;
    viewer.say("w3d").await;
    assert_eq!(viewer.hear().await, "world:a.wbt:a.wbt;b.WBT");
}
