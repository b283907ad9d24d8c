//! A demo simulator under test: how to start one, and what it prints.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::io::{AsyncBufReadExt as _, AsyncRead, BufReader};
use tokio::process::{Child, Command};
use tokio::sync::mpsc;
use tokio::time::timeout;

use super::viewer::Viewer;

/// The port that simulators are asked to use, below those that systems deal out.
pub(crate) const PORT: u16 = 21_234;
/// How long anything may take.
pub(crate) const DEADLINE: Duration = Duration::from_secs(30);

/// A world file; of which the first line counts.
pub(crate) const WORLD: &str = "#VRML_SIM R2025a utf8\nWorldInfo { }\nViewpoint { }\n";
/// A model with one robot that moves and one box that does not.
pub(crate) const MODEL: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<X3D>
  <head><meta name="simulator" content="demo"/></head>
  <Scene>
    <WorldInfo id="n1"/>
    <Viewpoint id="n2"/>
    <Solid id="n3" name="box"><Shape id="n4"><Box id="n5"/></Shape></Solid>
    <Robot id="n6" name="mover" translation="1 2 0" rotation="0 0 1 0"/>
  </Scene>
</X3D>
"#;
/// How that robot moves; steps are 10 ms long.
pub(crate) const MOTION: &str = r#"{
    "basicTimeStep": 10,
    "FPS": 50,
    "robots": {"mover": {"id": 6, "start": [1, 2, 0], "heading": 0, "radius": 0.4, "speed": 0.25}}
}"#;

/// How to start a simulator.
pub(crate) struct Start {
    arguments: Vec<String>,
    address: Ipv4Addr,
    world: Option<PathBuf>,
}

/// A running simulator, which is killed when it is dropped.
pub(crate) struct Simulator {
    child: Child,
    pub(crate) address: SocketAddr,
    out: mpsc::UnboundedReceiver<String>,
    printed: Arc<Mutex<String>>,
}

/// A loopback address that no other simulator of any test run here has.
pub(crate) fn own_address() -> Ipv4Addr {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    let [.., high, low] = std::process::id().to_be_bytes();
    Ipv4Addr::new(127, high, low, NEXT.fetch_add(1, Ordering::Relaxed))
}

/// A project whose folder `worlds` has these files.
pub(crate) fn project(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("worlds")).unwrap();
    for (name, text) in files {
        std::fs::write(folder.path().join("worlds").join(name), text).unwrap();
    }
    folder
}

/// A project with the small world `a.wbt`.
pub(crate) fn small_project() -> tempfile::TempDir {
    project(&[("a.wbt", WORLD), ("a.x3d", MODEL), ("a.motion.json", MOTION)])
}

impl Start {
    /// A simulator that is started with these arguments and no others.
    pub(crate) fn with(arguments: &[&str]) -> Self {
        Self { arguments: arguments.iter().map(ToString::to_string).collect(), address: own_address(), world: None }
    }

    /// A paused streaming simulator of a world, which also prints its remarks.
    pub(crate) fn paused(world: &Path) -> Self {
        let port = format!("--port={PORT}");
        let arguments = ["--batch", "--mode=pause", "--stream", "--stdout", &port];
        Self::with(&arguments).world(world)
    }

    /// Adds the world file.
    pub(crate) fn world(mut self, world: &Path) -> Self {
        self.world = Some(world.to_owned());
        self
    }

    /// Adds an argument.
    pub(crate) fn argument(mut self, argument: &str) -> Self {
        self.arguments.push(argument.to_owned());
        self
    }

    /// Adds some arguments.
    pub(crate) fn arguments(self, arguments: &[&str]) -> Self {
        arguments.iter().fold(self, |start, argument| start.argument(argument))
    }

    /// Listens on this address.
    pub(crate) fn on(mut self, address: Ipv4Addr) -> Self {
        self.address = address;
        self
    }

    /// Starts it and waits for nothing.
    pub(crate) fn spawn(self) -> Simulator {
        let mut child = Command::new(env!("CARGO_BIN_EXE_demo-simulator"))
            .args(&self.arguments)
            .args(self.world)
            .env("DEMO_SIMULATOR_BIND", self.address.to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .unwrap();
        let printed = Arc::new(Mutex::new(String::new()));
        let (sender, out) = mpsc::unbounded_channel();
        read_lines(child.stdout.take().unwrap(), "", Arc::clone(&printed), Some(sender));
        read_lines(child.stderr.take().unwrap(), "stderr: ", Arc::clone(&printed), None);
        Simulator { child, address: SocketAddrV4::new(self.address, PORT).into(), out, printed }
    }

    /// Starts it and waits until it listens, on whichever port it says.
    pub(crate) async fn listening(self) -> Simulator {
        let mut simulator = self.spawn();
        let line = simulator.line().await;
        let port = line.strip_prefix("INFO: Streaming server listening on port ").expect(&line);
        simulator.address.set_port(port.trim_end_matches('.').parse().unwrap());
        simulator
    }

    /// Starts it and waits until it has loaded its world.
    pub(crate) async fn playing(self) -> Simulator {
        let simulator = self.listening().await;
        simulator.spectator().await;
        simulator
    }
}

fn read_lines(
    stream: impl AsyncRead + Unpin + Send + 'static,
    prefix: &'static str,
    printed: Arc<Mutex<String>>,
    sender: Option<mpsc::UnboundedSender<String>>,
) {
    tokio::spawn(async move {
        let mut lines = BufReader::new(stream).lines();
        while let Ok(Some(line)) = lines.next_line().await {
            printed.lock().unwrap().extend([prefix, &line, "\n"]);
            if let Some(sender) = &sender {
                drop(sender.send(line));
            }
        }
    });
}

impl Simulator {
    /// The next line on its standard output.
    pub(crate) async fn line(&mut self) -> String {
        let line = timeout(DEADLINE, self.out.recv()).await.expect("no line in time");
        line.expect("the standard output has ended")
    }

    /// The next lines on its standard output must be these.
    pub(crate) async fn prints(&mut self, lines: &[&str]) {
        for expected in lines {
            assert_eq!(self.line().await, *expected);
        }
    }

    /// Whatever it printed so far; lines of the standard error start with `stderr: `.
    pub(crate) fn printed(&self) -> String {
        self.printed.lock().unwrap().clone()
    }

    /// Waits until it has printed a text, wherever.
    pub(crate) async fn has_printed(&self, text: &str) {
        let waiting = async {
            while !self.printed().contains(text) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        timeout(DEADLINE, waiting).await.expect(text);
    }

    pub(crate) fn signal(&self, signal: Signal) {
        let pid = i32::try_from(self.child.id().unwrap()).unwrap();
        kill(Pid::from_raw(pid), signal).unwrap();
    }

    /// Waits until it has ended and all it printed has been read.
    pub(crate) async fn end(&mut self) -> ExitStatus {
        let status = timeout(DEADLINE, self.child.wait()).await.expect("did not end in time").unwrap();
        while timeout(DEADLINE, self.out.recv()).await.expect("the output did not end").is_some() {}
        status
    }

    /// A new connection.
    pub(crate) async fn viewer(&self) -> Viewer {
        Viewer::connect(self.address).await
    }

    /// A viewer that only looks on and has seen the scene.
    pub(crate) async fn spectator(&self) -> Viewer {
        let mut viewer = self.viewer().await;
        viewer.say("w3d;broadcast").await;
        viewer.hears_scene().await;
        viewer
    }
}

impl Drop for Simulator {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("--- the simulator at {} printed:\n{}---", self.address, self.printed());
        }
    }
}
