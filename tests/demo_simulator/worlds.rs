//! What worlds become.

use std::path::Path;

use super::simulator::{Start, project};

const HEADER: &str = "#VRML_SIM R2025a utf8\n";

#[tokio::test]
async fn a_broken_world_is_replaced_by_an_empty_one_and_only_stderr_tells() {
    let no_header = "WorldInfo { }".to_owned();
    let unclosed = format!("{HEADER}Solid {{ name \"a");
    let deep = format!("{HEADER}{}", "Group { children ".repeat(100_000));
    let wild = format!("{HEADER}\u{0} }}}} ]] \"\\");
    let huge = format!("{HEADER}{}", " ".repeat(9 * 1024 * 1024));
    let doubling: Vec<String> =
        (1..50).map(|i| format!("DEF N{i} Group {{ children [ USE N{0} USE N{0} ] }}", i - 1)).collect();
    let doubling = doubling.concat();
    let exploding = format!("{HEADER}DEF N0 Group {{ }}{doubling}");
    for text in [no_header, unclosed, deep, wild, huge, exploding, String::new()] {
        let project = project(&[("a.wbt", &text)]);
        let world = project.path().join("worlds/a.wbt");
        let mut quiet = Start::paused(&world).argument("--heartbeat=1").listening().await;
        let mut viewer = quiet.viewer().await;
        viewer.say("w3d").await;
        let model = loop {
            let heard = viewer.hear().await;
            if heard.starts_with("model:") {
                break heard;
            }
        };
        assert!(model.contains("<Viewpoint") && !model.contains("<Solid"), "{model}");
        quiet.prints(&["."]).await;
        assert!(!quiet.printed().contains("stderr"));
        let loud = Start::paused(&world).argument("--stderr").listening().await;
        loud.has_printed("stderr: ERROR: '").await;
    }
}

#[tokio::test]
async fn the_demo_worlds_have_robots_that_move() {
    for (name, robots) in [("playground.wbt", 3), ("carousel.wbt", 4)] {
        let world = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/demo/worlds").join(name);
        let simulator = Start::paused(&world).argument("--stderr").playing().await;
        let mut viewer = simulator.viewer().await;
        viewer.say("w3d").await;
        let worlds = viewer.hear().await;
        assert_eq!(worlds, format!("world:worlds/{name}:worlds/carousel.wbt;worlds/playground.wbt"));
        let model = viewer.hear().await;
        assert_eq!(model.matches("<Robot ").count(), robots);
        assert!(model.contains("<Background ") && model.contains("<DirectionalLight "));
        viewer.hears(&["application/json:", "scene load completed", "pause: 0"]).await;
        for _ in 0..2 {
            viewer.say("step").await;
            let update = viewer.hear().await;
            assert_eq!(update.matches("\"translation\"").count(), robots, "{update}");
            viewer.hears(&["paused by client"]).await;
        }
        assert!(!simulator.printed().contains("stderr"));
    }
}

#[tokio::test]
async fn each_node_becomes_an_element_with_its_number() {
    let text = r#"#VRML_SIM R2025a utf8
        EXTERNPROTO "https://example.org/Floor.proto"
        Floor { size 3 3 appearance Parquetry { type "}" } }  # a comment }
        WorldInfo { title "<a> & \"b\"" basicTimeStep 16 }
        Viewpoint { position -4 0 2 near 0.1 }
        Solid {
          name "it's"
          translation 0 0 .5
          children Shape {
            castShadows TRUE
            appearance PBRAppearance { baseColor 1 0 0 baseColorMap ImageTexture { url "a.png" } }
            geometry Box { size 1, 2, 3 }
          }
          boundingObject Box { }
        }
        DEF PAIR Group { children [ Pose { } Group { } ] }
        USE PAIR
    "#;
    let project = project(&[("a.wbt", text)]);
    let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
    let mut viewer = simulator.viewer().await;
    viewer.say("w3d").await;
    viewer.hears(&["world:"]).await;
    assert_eq!(
        viewer.hear().await,
        concat!(
            r#"model:<?xml version="1.0" encoding="UTF-8"?><X3D><head><meta name="generator" content="Webots"/>"#,
            r#"<meta name="version" content="R2025a"/><meta name="simulator" content="demo"/></head><Scene>"#,
            r#"<WorldInfo id="n1" title="&lt;a&gt; &amp; &quot;b&quot;" basicTimeStep="16"/>"#,
            r#"<Viewpoint id="n2" position="-4 0 2" zNear="0.1"/>"#,
            r#"<Solid id="n3" name="it&apos;s" translation="0 0 0.5"><Shape id="n4" castShadows="true">"#,
            r#"<PBRAppearance id="n5" baseColor="1 0 0"/><Box id="n6" size="1 2 3"/></Shape></Solid>"#,
            r#"<Group id="n7"><Pose id="n8"/><Group id="n9"/></Group>"#,
            r#"<Group id="n10"><Pose id="n11"/><Group id="n12"/></Group></Scene></X3D>"#,
        )
    );
}
