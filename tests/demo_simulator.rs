//! Black-box tests of the demo simulator. They check what `docs/webots.md` says about it; the rest is covered by other
//! tests, which use it in place of Webots.

use std::fs::File;
use std::net::Ipv4Addr;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Command};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::support::stopwatch::Stopwatch;
use crate::support::{Client, SOON, until};

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
/// What Webots exports of a world, in the form of its releases until R2023b.
const EXPORT: &str =
    "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<!DOCTYPE X3D>\n<X3D>\n  <Scene>\n  </Scene>\n</X3D>\n";
/// Its animation: frames that are 50 ms apart, with their own order of fields, and one without a change.
const FRAMES: [&str; 5] = [
    r#"{"time":0,"updates":[{"id":301,"translation":"0 0 0","rotation":"0 0 1 3.1416","scale":"1 1 1"}]}"#,
    r#"{"time":50,"updates":[{"id":301,"translation":"-0.002 0 0","rotation":"0.0012 0 1 3.1416"}]}"#,
    r#"{"time":100,"updates":[{"id":301,"translation":"-0.0059 0 0"}],"labels":[{"id":0,"text":"a label","x":0}]}"#,
    r#"{"time":150}"#,
    r#"{"time":200,"updates":[{"id":301,"translation":"-0.0099 0 0"}]}"#,
];
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
        Self::of(WORLD)
    }

    /// Starts a simulator whose first world has these options.
    fn with(options: &str) -> Self {
        Self::of(&WORLD.replacen('\n', &format!("\n#demo-simulator: {options}\n"), 1))
    }

    /// Starts a simulator of this world.
    fn of(world: &str) -> Self {
        let address = own_address();
        let project = tempfile::tempdir().unwrap();
        let worlds = project.path().join("worlds");
        std::fs::create_dir(&worlds).unwrap();
        for (name, robot, world) in [("a", "mover", world), ("b", "other mover", WORLD)] {
            std::fs::write(worlds.join(name).with_extension("wbt"), world).unwrap();
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
            "--heartbeat=50",
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

    fn output(&self) -> String {
        std::fs::read_to_string(self.project.path().join("output")).unwrap()
    }

    /// Waits until it has printed this.
    async fn prints(&self, words: &str) {
        until(words, async || self.output().contains(words)).await;
    }

    /// Waits until the simulator listens.
    async fn listens(&self) {
        self.prints(&format!("server listening on port {PORT}.")).await;
    }

    /// Connects once the simulator listens.
    async fn connect(&self) -> Client {
        self.listens().await;
        Client::connect(&format!("ws://{}:{PORT}/", self.address)).await
    }

    /// Sends these bytes and returns the answer, up to the end of the connection.
    async fn answer(&self, request: &str) -> String {
        String::from_utf8(self.bytes(request).await).unwrap()
    }

    /// The same in bytes.
    async fn bytes(&self, request: &str) -> Vec<u8> {
        let mut stream = TcpStream::connect((self.address, PORT)).await.unwrap();
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        let read = stream.read_to_end(&mut answer);
        actix_rt::time::timeout(SOON, read).await.unwrap().unwrap();
        answer
    }

    /// The answer to a controller for a robot that is not there.
    async fn answer_to_controller(&self) -> String {
        self.answer("CTR\nRobot-Name: %2F\n\n").await
    }

    /// The answer to a request for a file.
    async fn file(&self, path: &str) -> String {
        self.answer(&format!("GET {path} HTTP/1.1\r\nHost: here:1\r\n\r\n"))
            .await
    }

    async fn crashes(&mut self) {
        until("it has ended", async || self.child.try_wait().unwrap().is_some()).await;
        assert_eq!(self.child.wait().unwrap().signal(), Some(Signal::SIGSEGV as i32));
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
    for first in ["w3d", "w3d;broadcast"] {
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
async fn an_export_is_streamed_as_it_stands_in_its_files_at_the_pace_of_its_animation() {
    let simulator = Simulator::start();
    let preview = simulator.project.path().join("preview");
    std::fs::create_dir(&preview).unwrap();
    std::fs::write(preview.join("scene.x3d"), EXPORT).unwrap();
    let animation = FRAMES.join(",\n");
    std::fs::write(
        preview.join("animation.json"),
        format!("{{\n \"basicTimeStep\":50,\n \"labelsIds\":\"0\",\n \"frames\":[\n{animation}\n ]\n}}\n"),
    )
    .unwrap();
    // only then is the first world shown by it
    std::fs::remove_file(simulator.project.path().join("worlds/a.x3d")).unwrap();
    // no text in any encoding
    let texture: Vec<u8> = (0..=255).rev().cycle().take(100_000).collect();
    std::fs::write(preview.join("texture.png"), &texture).unwrap();

    let mut viewer = simulator.connect().await;
    viewer.send("reload").await;
    let model = viewer.until("model:").await;
    if model.contains("mover") {
        assert_eq!(viewer.until("model:").await, format!("model:{EXPORT}"));
    } else {
        assert_eq!(model, format!("model:{EXPORT}"));
    }
    viewer.until("scene load completed").await;
    let request = "GET /preview/texture.png HTTP/1.1\r\nHost: here\r\n\r\n";
    let answer = simulator.bytes(request).await;
    let head = answer.len() - texture.len();
    assert!(answer[..head].ends_with(b"\r\n\r\n"), "nothing is lost or added");
    assert!(answer[head..] == texture);
    for frame in &FRAMES[1..] {
        viewer.send("step").await;
        assert_eq!(
            viewer.until("application/json:").await,
            format!("application/json:{frame}")
        );
    }
    let mut late = simulator.connect().await;
    late.send("w3d;broadcast").await;
    let state = r#"{"time":200,"updates":[{"id":301,"rotation":"0.0012 0 1 3.1416","scale":"1 1 1","translation":"-0.0099 0 0"}],"labels":[{"id":0,"text":"a label","x":0}]}"#;
    assert_eq!(
        late.until("application/json:").await,
        format!("application/json:{state}")
    );

    viewer.send("reset").await;
    viewer.until("reset finished").await;
    let stopwatch = Stopwatch::start();
    let lap = stopwatch.lap();
    viewer.send("real-time:-1").await;
    viewer.heard.clear();
    // Longer than the animation.
    let mut time = 0.0;
    while time < 600.0 {
        time = viewer.time().await;
    }
    assert!(
        lap.wall() > Duration::from_secs_f64(time / 1000.0 - 0.1),
        "{time}: {:?}",
        lap.wall()
    );
    assert!(
        lap.elapsed() < Duration::from_secs_f64(time / 1000.0 + 0.4),
        "{time}: {:?}",
        lap.elapsed()
    );
    let updates = viewer.heard.iter().filter(|text| text.starts_with("application/json:"));
    assert!(updates.count() > 3, "{:?}", viewer.heard);

    // The form of the releases since R2025a comes first.
    let scene = format!("{EXPORT}<!-- \u{e9} -->\r\n\t");
    std::fs::write(preview.join("scene.w3d"), &scene).unwrap();
    viewer.send("reload").await;
    assert_eq!(viewer.until("model:").await, format!("model:{scene}"));
}

#[actix_rt::test]
async fn an_action_of_one_viewer_moves_the_world_of_all() {
    let simulator = Simulator::start();
    let mut one = simulator.spectator().await;
    let mut other = simulator.spectator().await;
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
        assert_eq!(viewer.closed().await, Some(1001));
        simulator.ends_with(0).await;
    }
}

#[actix_rt::test]
async fn a_client_of_a_world_that_is_not_there_yet_crashes_it() {
    let mut simulator = Simulator::with("download=60");
    let mut silent = simulator.connect().await;
    silent.until("loading:Downloading assets:").await;
    assert_eq!(simulator.answer_to_controller().await, "PROCESSING");
    simulator.prints("\n.\n").await;
    let mut viewer = simulator.connect().await;
    viewer.send("w3d;broadcast").await;
    simulator.crashes().await;
    // Until R2023a, a controller did too.
    let mut simulator = Simulator::of("#VRML_SIM R2023a utf8\n#demo-simulator: download=60\n");
    simulator.listens().await;
    let mut controller = TcpStream::connect((simulator.address, PORT)).await.unwrap();
    controller.write_all(b"CTR\nRobot-Name: %2F\n\n").await.unwrap();
    simulator.crashes().await;
}

#[actix_rt::test]
async fn while_a_world_is_read_nothing_is_answered() {
    let simulator = Simulator::with("download=0.3 load=2");
    let mut silent = simulator.connect().await;
    silent.until("loading:Reading world file :0").await;
    // Soon the kernel accepts the connections, and nothing answers.
    let mut beats = 0;
    until("it is blocked", async || {
        beats = simulator.output().matches("\n.").count();
        let answer = simulator.file("/worlds/a.png");
        actix_rt::time::timeout(Duration::from_millis(400), answer)
            .await
            .is_err()
    })
    .await;
    assert!(simulator.output().matches("\n.").count() <= beats + 1);
    // What was sent meanwhile is answered later.
    let mut early = simulator.connect().await;
    early.send("w3d").await;
    early.until("scene load completed").await;
    // Without a request, every client gets the new scene too.
    silent.until("world:worlds/a.wbt:").await;
    silent.until("scene load completed").await;
    assert_eq!(simulator.answer_to_controller().await, "FAILED");
    let beats = simulator.output().matches("\n.").count();
    until("the heart beats", async || {
        simulator.output().matches("\n.").count() > beats
    })
    .await;
    // A reload takes the same time.
    let begin = Instant::now();
    early.send("reload").await;
    early.until("delete world").await;
    silent.until("loading:Reading world file :0").await;
    early.until("scene load completed").await;
    assert!(begin.elapsed() > Duration::from_secs(1));
}

#[actix_rt::test]
async fn a_busy_simulation_answers_nobody() {
    let simulator = Simulator::with("busy=1.5@0.3");
    simulator.listens().await;
    let mut longest = Duration::ZERO;
    until("it was busy", async || {
        let begin = Instant::now();
        assert_eq!(simulator.answer_to_controller().await, "FAILED");
        longest = longest.max(begin.elapsed());
        longest > Duration::from_secs(1)
    })
    .await;
}

#[actix_rt::test]
async fn a_release_knows_one_kind_of_scene_and_calls_the_other_unsupported() {
    for (release, known, other) in [
        ("R2025a", "w3d", "x3d"),
        ("R2023b", "x3d", "w3d"),
        ("R2022b", "x3d", "w3d"),
    ] {
        let simulator = Simulator::of(&WORLD.replace("R2025a", release));
        let mut viewer = simulator.connect().await;
        viewer.send(other).await;
        viewer.send("nonsense").await;
        // Errors wait for the first request of a scene, and then come in one message.
        viewer.send(&format!("{known};broadcast")).await;
        let texts = viewer.until("stderr:").await;
        let error = |text: &str| format!("stderr:ERROR: Streaming server: Unsupported message: {text}.");
        assert_eq!(texts, [error(other), error("nonsense")].join("\n"));
        assert!(viewer.heard[0].starts_with("world:"), "{:?}", viewer.heard);
        viewer.send("pictures").await;
        assert_eq!(viewer.until("").await, error("pictures"));
        simulator
            .prints("ERROR: Streaming server: Unsupported message: pictures.")
            .await;
    }
}

#[actix_rt::test]
async fn updates_go_to_every_websocket() {
    let simulator = Simulator::start();
    let mut silent = simulator.connect().await;
    let mut player = simulator.spectator().await;
    player.send("real-time:-1").await;
    assert!(silent.until("").await.starts_with("application/json:{\"time\":"));
}

#[actix_rt::test]
async fn it_pauses_by_a_timeout_only_with_clients_and_a_broadcast_clears_the_timeout() {
    let simulator = Simulator::start();
    let mut player = simulator.spectator().await;
    player.send("real-time:300").await;
    let mut watcher = simulator.spectator().await;
    while player.time().await < 600.0 {}
    watcher.send("timeout:100").await;
    player.until("pause: ").await;
    // Nobody is there when the time is over.
    player.send("real-time:3000").await;
    player.until("real-time").await;
    let pauses = simulator.output().matches("\npause").count();
    player.leave().await;
    watcher.leave().await;
    actix_rt::time::sleep(Duration::from_millis(3500)).await;
    assert_eq!(
        simulator.output().matches("\npause").count(),
        pauses,
        "{}",
        simulator.output()
    );
    let mut back = simulator.connect().await;
    back.until("pause: ").await;
}

#[actix_rt::test]
async fn files_are_served_as_by_webots() {
    let simulator = Simulator::start();
    simulator.listens().await;
    let project = simulator.project.path();
    std::fs::write(project.join("worlds/a page.html"), "see webots://file").unwrap();
    let outside = tempfile::Builder::new().suffix(".png").tempfile().unwrap();
    std::fs::write(outside.path(), "secret").unwrap();
    let found = simulator.file("/worlds/a%20page.html?name=x").await;
    let (head, body) = found.split_once("\r\n\r\n").unwrap();
    assert_eq!(body, "see http://here:1/file");
    for line in [
        "HTTP/1.1 200 OK",
        "Access-Control-Allow-Origin: *",
        "Cache-Control: public, max-age=3600",
        "Content-Type: text/html",
        "Content-Length: 22",
    ] {
        assert!(head.lines().any(|one| one == line), "{line}: {head}");
    }
    let etag = head.lines().find_map(|line| line.strip_prefix("etag: ")).unwrap();
    let again = format!("GET /worlds/a%20page.html HTTP/1.1\r\nHost: here:1\r\nIf-None-Match: {etag}\r\n\r\n");
    assert!(simulator.answer(&again).await.starts_with("HTTP/1.1 304 "));
    // The path may leave the project, as it is or encoded.
    for up in ["../", "%2e%2e/", "..%2F"] {
        let path = format!("/{}{}", up.repeat(20), &outside.path().to_str().unwrap()[1..]);
        assert!(simulator.file(&path).await.ends_with("\r\n\r\nsecret"), "{path}");
    }
    assert!(simulator.file("/worlds/none.png").await.starts_with("HTTP/1.1 404 "));
    assert!(!simulator.output().contains("WARNING"), "{}", simulator.output());
    for (path, warning) in [
        ("/robots.txt", "WARNING: Unsupported file type '/robots.txt'."),
        ("/worlds/a.wbt", "WARNING: Unsupported file type '/worlds/a.wbt'."),
        (
            "/none.html",
            "WARNING: Cannot read 'none.html', sending \"404 Not Found\".",
        ),
    ] {
        assert!(simulator.file(path).await.starts_with("HTTP/1.1 404 "), "{path}");
        simulator.prints(warning).await;
    }
    // There is no HEAD, and no second request on a connection.
    assert!(
        simulator
            .answer("HEAD /none.html HTTP/1.1\r\nHost: a\r\n\r\n")
            .await
            .starts_with("HTTP/1.1 400 ")
    );
    let two = "GET /worlds/none.png HTTP/1.1\r\nHost: a\r\n\r\n".repeat(2);
    assert_eq!(simulator.answer(&two).await.matches("HTTP/1.1").count(), 1);
}
