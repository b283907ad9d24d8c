//! What clients are shown of a world.

use std::path::{Path, PathBuf};

use regex::Regex;

use super::simulator::Start;

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
    let robots = Regex::new("<Robot [^>]*>").unwrap();
    let robot = |tag: &str| {
        let attribute =
            |name: &str| tag.split_once(&format!(" {name}=\"")).unwrap().1.split('"').next().unwrap().to_owned();
        let rotation = numbers(&attribute("rotation"));
        assert_eq!(rotation[..3], [0.0, 0.0, 1.0], "robots turn about the vertical axis");
        let id = attribute("id").trim_start_matches('n').parse().unwrap();
        (attribute("name"), id, numbers(&attribute("translation")), rotation[3])
    };
    robots.find_iter(model).map(|found| robot(found.as_str())).collect()
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
