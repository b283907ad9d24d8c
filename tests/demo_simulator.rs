//! Black-box tests of the demo simulator, with viewers and signals. The rest is covered by other tests, which use it in
//! place of Webots.

use std::fs::File;
use std::net::Ipv4Addr;
use std::process::{Child, Command};
use std::sync::atomic::{AtomicU8, Ordering};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::support::{Client, until};

/// The simulator's port, below the ephemeral ports.
const PORT: u16 = 21_234;
const WORLD: &str = "#VRML_SIM R2025a utf8\nWorldInfo { }\nViewpoint { }\n";
/// A model with one robot that moves and one box that does not.
const MODEL: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<X3D>
  <head><meta name="simulator" content="demo"/></head>
  <Scene>
    <Solid id="n3" name="box"><Shape id="n4"><Box id="n5"/></Shape></Solid>
    <Robot id="n6" name="mover" translation="1 2 0" rotation="0 0 1 0"/>
  </Scene>
</X3D>
"#;
/// The motion of that robot; steps are 10 ms long.
const MOTION: &str = r#"{
    "basicTimeStep": 10,
    "FPS": 50,
    "robots": {"mover": {"id": 6, "start": [1, 2, 0], "heading": 0, "radius": 0.4, "speed": 0.25}}
}"#;
/// The robot's initial position.
const START: &str = r#"application/json:{"time":0,"updates":[{"id":6,"translation":"1 2 0","rotation":"0 0 1 0"}]}"#;

/// A simulator with a project of two worlds, killed on drop.
struct Simulator {
    child: Child,
    address: Ipv4Addr,
    project: tempfile::TempDir,
}

impl Simulator {
    /// Starts a simulator, which is paused.
    fn start() -> Self {
        let address = own_address();
        let project = tempfile::tempdir().unwrap();
        let worlds = project.path().join("worlds");
        std::fs::create_dir(&worlds).unwrap();
        for (name, robot) in [("a", "mover"), ("b", "other mover")] {
            std::fs::write(worlds.join(name).with_extension("wbt"), WORLD).unwrap();
            std::fs::write(worlds.join(name).with_extension("x3d"), MODEL.replace("mover", robot)).unwrap();
            std::fs::write(worlds.join(name).with_extension("motion.json"), MOTION).unwrap();
        }
        let output = File::create(project.path().join("output")).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_demo-simulator"));
        command.args([
            "--batch",
            "--mode=pause",
            "--stream",
            "--stdout",
            "--stderr",
            &format!("--port={PORT}"),
        ]);
        command
            .arg(worlds.join("a.wbt"))
            .env("DEMO_SIMULATOR_BIND", address.to_string());
        let child = command
            .stdout(output.try_clone().unwrap())
            .stderr(output)
            .spawn()
            .unwrap();
        Self {
            child,
            address,
            project,
        }
    }

    /// Connects once the simulator listens.
    async fn connect(&self) -> Client {
        let (output, words) = (
            self.project.path().join("output"),
            format!("server listening on port {PORT}."),
        );
        until(&words, async || {
            std::fs::read_to_string(&output).unwrap().contains(&words)
        })
        .await;
        Client::connect(&format!("ws://{}:{PORT}/", self.address)).await
    }

    /// A broadcast viewer that has received the scene.
    async fn spectator(&self) -> Client {
        let mut viewer = self.connect().await;
        viewer.send("w3d;broadcast").await;
        viewer.until("scene load completed").await;
        viewer.next().await;
        viewer.heard.clear();
        viewer
    }

    async fn ends_with(&mut self, code: i32) {
        until("it has ended", async || self.child.try_wait().unwrap().is_some()).await;
        assert_eq!(self.child.wait().unwrap().code(), Some(code));
    }
}

impl Drop for Simulator {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

/// A loopback address that no other simulator has, in any test run on this machine.
fn own_address() -> Ipv4Addr {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    let [.., high, low] = std::process::id().to_be_bytes();
    Ipv4Addr::new(127, high, low, NEXT.fetch_add(1, Ordering::Relaxed))
}

#[actix_rt::test]
async fn a_viewer_hears_the_whole_scene_first() {
    let simulator = Simulator::start();
    for first in ["x3d", "w3d", "x3d;broadcast", "w3d;broadcast"] {
        let mut viewer = simulator.connect().await;
        viewer.send(first).await;
        viewer.until("pause: 0").await;
        let scene = viewer.heard.iter().position(|text| text.starts_with("world:")).unwrap();
        let [world, model, rest @ ..] = &viewer.heard[scene..] else {
            panic!("{:?}", viewer.heard)
        };
        assert_eq!(world, "world:worlds/a.wbt:worlds/a.wbt;worlds/b.wbt");
        assert!(
            model.starts_with("model:<?xml version=\"1.0\" encoding=\"UTF-8\"?><X3D>"),
            "{model}"
        );
        assert!(
            model.contains(r#"<Robot id="n6" name="mover" translation="1 2 0" rotation="0 0 1 0"/>"#),
            "{model}"
        );
        assert_eq!(rest, [START, "scene load completed", "pause: 0"]);
    }
}

#[actix_rt::test]
async fn an_action_of_one_viewer_moves_the_world_of_all() {
    let simulator = Simulator::start();
    let (mut one, mut other) = (simulator.spectator().await, simulator.spectator().await);
    one.send("pause").await;
    one.until("paused by client").await;
    for time in ["10", "20"] {
        one.send("step").await;
        one.until("paused by client").await;
        other
            .until(&format!("application/json:{{\"time\":{time},\"updates\":[{{\"id\":6,"))
            .await;
    }
    one.send("reset").await;
    one.until("reset finished").await;
    other.until("reset finished").await;
    assert_eq!(other.heard.len(), 4, "{:?}", other.heard);
    assert_eq!(other.heard[2..], [START, "reset finished"]);
    assert_eq!(
        one.heard.iter().filter(|text| !other.heard.contains(text)).count(),
        3,
        "{:?}",
        one.heard
    );
    let renamed = MODEL.replace("mover", "changed mover");
    std::fs::write(simulator.project.path().join("worlds/a.x3d"), renamed).unwrap();
    for (command, world, robot) in [
        ("reload", "worlds/a.wbt", "changed mover"),
        ("revert", "worlds/a.wbt", "changed mover"),
        ("load:b.wbt", "worlds/b.wbt", "other mover"),
        ("load:../worlds/a.wbt", "worlds/a.wbt", "changed mover"),
    ] {
        one.send(command).await;
        for viewer in [&mut one, &mut other] {
            viewer.until("delete world").await;
            viewer.until(&format!("world:{world}:")).await;
            let model = viewer.until("model:").await;
            assert!(model.contains(&format!("name=\"{robot}\"")), "{command}: {model}");
            viewer.until("scene load completed").await;
        }
    }
}

#[actix_rt::test]
async fn later_viewers_receive_the_mode_of_the_simulation() {
    let simulator = Simulator::start();
    for mode in ["real-time", "fast"] {
        let mut viewer = simulator.spectator().await;
        viewer.send(&format!("{mode}:-1")).await;
        viewer.until(mode).await;
        let mut late = simulator.connect().await;
        late.send("w3d;broadcast").await;
        late.until(mode).await;
        let time = viewer.time().await;
        assert!(viewer.time().await > time, "{:?}", viewer.heard);
        // A viewer that does not ask for broadcast pauses the simulation, as does the message `pause`.
        if mode == "fast" {
            let mut player = simulator.connect().await;
            player.send("w3d").await;
            viewer.until("pause: ").await;
        } else {
            viewer.send("pause").await;
            viewer.until("paused by client").await;
        }
    }
}

#[actix_rt::test]
async fn a_signal_ends_it_with_0_after_the_closing_handshake() {
    for signal in [Signal::SIGTERM, Signal::SIGINT] {
        let mut simulator = Simulator::start();
        let mut viewer = simulator.spectator().await;
        let _silent = simulator.spectator().await;
        kill(Pid::from_raw(simulator.child.id().cast_signed()), signal).unwrap();
        // On any other code Webots' page shows a dialog.
        assert_eq!(viewer.closed().await, Some(1000));
        simulator.ends_with(0).await;
    }
}
