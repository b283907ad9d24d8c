//! A copy of the project in a temporary folder, with its own ports and the programs under test.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use serde_json::{Value, json};

use crate::support::{holds_soon, ports};

/// Timeout of every call of `server.sh`.
const LIMIT: Duration = Duration::from_secs(90);

/// The folder of the project under test.
pub fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A copy of the project. On drop its servers are stopped, and their logs are printed if the test fails.
pub struct Project {
    temporary: tempfile::TempDir,
    /// The port of the session server.
    pub session: u16,
    /// The port of the simulation server.
    pub simulation: u16,
}

/// The result of a command.
#[derive(Debug)]
pub struct Outcome {
    pub code: Option<i32>,
    pub output: String,
    pub errors: String,
}

impl Project {
    /// Copies what `server.sh` needs.
    pub fn copy() -> Self {
        // Webots may take one of the ten ports after its own.
        let session = ports::block(24);
        let project = Self {
            temporary: tempfile::tempdir().unwrap(),
            session,
            simulation: session + 1,
        };
        copy(&root().join("server.sh"), &project.path("server.sh"));
        copy(&root().join("config"), &project.path("config"));
        copy(&root().join("tests/websocket.sh"), &project.path("tests/websocket.sh"));
        for name in ["demo", "local"] {
            project.configure(&format!("session/{name}"), |config| {
                config["port"] = session.into();
                config["bind"] = "127.0.0.1".into();
                config["simulationServers"] = json!([format!("localhost:{}", session + 1)]);
                config["loadRefresh"] = 0.1.into();
                // Other load on this machine must not make the server full.
                config["loadThreshold"] = 1000.into();
            });
            project.configure(&format!("simulation/{name}"), |config| {
                config["port"] = (session + 1).into();
                config["bind"] = "127.0.0.1".into();
            });
        }
        project.configure("simulation/demo", |config| {
            config["webots"] = env!("CARGO_BIN_EXE_demo-simulator").into()
        });
        project
    }

    /// The project's folder; its name has a space in it.
    pub fn folder(&self) -> PathBuf {
        self.temporary.path().join("a project")
    }

    pub fn path(&self, inside: &str) -> PathBuf {
        self.folder().join(inside)
    }

    /// Changes a configuration file, `KIND/NAME`.
    pub fn configure(&self, name: &str, change: impl FnOnce(&mut Value)) {
        let file = self.path(&format!("config/{name}.json"));
        let mut config = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
        change(&mut config);
        std::fs::write(&file, config.to_string()).unwrap();
    }

    /// Runs `server.sh` from another working directory.
    pub async fn server_sh(&self, arguments: &[&str]) -> Outcome {
        let command = tokio::process::Command::new(self.path("server.sh"))
            .args(arguments)
            .current_dir(self.temporary.path())
            .env("FLEET_BIN", programs())
            .stdin(Stdio::null())
            .kill_on_drop(true)
            .output();
        let output = actix_rt::time::timeout(LIMIT, command).await;
        let output = output
            .unwrap_or_else(|_| panic!("server.sh {arguments:?} does not end"))
            .unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        Outcome {
            code: output.status.code(),
            output: text(output.stdout),
            errors: text(output.stderr),
        }
    }

    /// Like `server_sh`, but asserts success; returns the output.
    pub async fn done(&self, arguments: &[&str]) -> String {
        let outcome = self.server_sh(arguments).await;
        assert_eq!(outcome.code, Some(0), "{arguments:?}: {outcome:#?}");
        // Warnings that the machine lacks something optional are no errors.
        let faults = outcome
            .errors
            .lines()
            .filter(|line| !line.starts_with("warning: ") || !line.contains(" is not there"));
        assert_eq!(
            faults.collect::<Vec<_>>(),
            Vec::<&str>::new(),
            "{arguments:?}: {outcome:#?}"
        );
        outcome.output
    }

    /// A URL of the session server.
    pub fn session_url(&self, path: &str) -> String {
        format!("http://localhost:{}{path}", self.session)
    }

    /// What earlier servers have left: processes, PID files, folders of runs, ports that accept connections.
    pub fn leftovers(&self) -> Vec<String> {
        let mut left = processes_in(&self.folder());
        let pid_files = walk(&self.path("log"))
            .into_iter()
            .filter(|path| path.extension().is_some_and(|kind| kind == "pid"));
        let runs = std::fs::read_dir(self.path("cache/runs"))
            .into_iter()
            .flatten()
            .map(|entry| entry.unwrap().path());
        left.extend(pid_files.chain(runs).map(|path| path.display().to_string()));
        for port in self.session..self.session + 12 {
            if std::net::TcpStream::connect(("127.0.0.1", port)).is_ok() {
                left.push(format!("port {port}"));
            }
        }
        left
    }

    /// The process id of the server of this `kind` and configuration.
    pub fn pid(&self, kind: &str, name: &str) -> i32 {
        let text = std::fs::read_to_string(self.path(&format!("log/{kind}/{name}.pid"))).unwrap();
        text.trim().parse().unwrap()
    }
}

impl Drop for Project {
    fn drop(&mut self) {
        let stop = ["90", "bash"]
            .into_iter()
            .map(PathBuf::from)
            .chain([self.path("server.sh"), "stop".into()]);
        std::process::Command::new("timeout")
            .args(stop)
            .env("FLEET_BIN", programs())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .status()
            .ok();
        if std::thread::panicking() {
            for log in walk(&self.path("log")) {
                eprintln!(
                    "--- {} ---\n{}",
                    log.display(),
                    std::fs::read_to_string(&log).unwrap_or_default()
                );
            }
        }
    }
}

/// The folder of the programs under test.
pub fn programs() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_session-server")).parent().unwrap()
}

/// The processes whose working directory is a folder or below it.
pub fn processes_in(folder: &Path) -> Vec<String> {
    let folder = folder.canonicalize().unwrap();
    let processes = procfs::process::all_processes().unwrap().flatten();
    processes
        .filter(|process| process.cwd().is_ok_and(|cwd| cwd.starts_with(&folder)))
        .map(|process| {
            format!(
                "process {} {}",
                process.pid(),
                process.cmdline().unwrap_or_default().join(" ")
            )
        })
        .collect()
}

/// Waits until nothing of a project is left; panics with the leftovers otherwise.
pub async fn nothing_is_left(project: &Project) {
    let nothing = holds_soon(async || project.leftovers().is_empty()).await;
    assert!(nothing, "left: {:#?}", project.leftovers());
}

/// All files below a folder.
pub fn walk(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(walk(&path));
        } else {
            files.push(path);
        }
    }
    files.sort();
    files
}

fn copy(from: &Path, to: &Path) {
    let files = if from.is_dir() {
        walk(from)
    } else {
        vec![from.to_owned()]
    };
    for file in files {
        let to = if file == from {
            to.to_owned()
        } else {
            to.join(file.strip_prefix(from).unwrap())
        };
        std::fs::create_dir_all(to.parent().unwrap()).unwrap();
        std::fs::copy(&file, &to).unwrap();
    }
}
