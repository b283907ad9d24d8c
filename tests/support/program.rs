//! The built programs as child processes.

use std::cell::Cell;
use std::fs::File;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use super::git::Forge;
use super::webots::Webots;
use super::{holds_soon, http, ports, raise_file_limit};

/// A server that was started for one test. It is killed with the test, and its log is printed if the test fails.
pub struct Server {
    child: Child,
    /// Directory of its configuration, log and cache.
    pub folder: PathBuf,
    /// Its port on the loopback.
    pub port: u16,
    name: &'static str,
    /// Whether other processes may serve its configuration, which end with it.
    is_upgraded: Cell<bool>,
    _temporary: Option<tempfile::TempDir>,
    _parts: Option<(Forge, Webots)>,
}

/// A server before it is started.
pub struct Builder {
    program: &'static str,
    name: &'static str,
    config: Value,
    port: u16,
    environment: Vec<(String, String)>,
    folder: Option<PathBuf>,
    before: Option<String>,
    parts: Option<(Forge, Webots)>,
}

/// A session server that monitors these simulation servers (`HOST:PORT`).
pub fn session_server(simulation_servers: &[String]) -> Builder {
    let port = ports::block(1);
    let config = serde_json::json!({
        "server": "localhost", "ssl": false, "portRewrite": false, "bind": "127.0.0.1", "port": port, "debug": true,
        "simulationServers": simulation_servers, "loadRefresh": 0.1,
    });
    Builder::new(env!("CARGO_BIN_EXE_session-server"), config, port)
}

/// A simulation server with this many slots, which starts this program as Webots and allows worlds of
/// `https://github.com/lab`, taken from the folder `repositories`.
pub fn simulation_server(webots: &Path, repositories: &Path, places: u16) -> Builder {
    // Webots may use one of the ten ports after its own.
    let port = ports::block(places + 12);
    let config = serde_json::json!({
        "server": "localhost", "ssl": false, "portRewrite": false, "bind": "127.0.0.1", "port": port, "debug": true,
        "webots": webots, "maxConnections": places, "allowedRepositories": ["https://github.com/lab"],
        "gitMirrors": {"https://github.com/": format!("file:{}", repositories.display())},
        // Most tests don't open the stream of a simulation that they keep.
        "timing": {"arrival": 0, "silence": 300},
        // The demo simulator may be in a home, which sandboxes hide.
        "environment": ["DEMO_SIMULATOR_BIND"], "sandbox": {"readable": [env!("CARGO_BIN_EXE_demo-simulator")]},
    });
    Builder::new(env!("CARGO_BIN_EXE_simulation-server"), config, port).env("DEMO_SIMULATOR_BIND", "127.0.0.1")
}

/// A simulation server with the demo simulator and a forge of its own that has `lab/arm`.
pub fn demo_server(places: u16) -> Builder {
    server_of(Webots::launcher(), places)
}

/// Like [`demo_server`], with this Webots.
pub fn server_of(webots: Webots, places: u16) -> Builder {
    let forge = Forge::with_arm();
    let builder = simulation_server(&webots.path(), forge.path(), places);
    Builder {
        parts: Some((forge, webots)),
        ..builder
    }
}

/// A server with one slot, whose simulation reaches a state, as servers call it, and stays there. In `checkingout` it
/// waits for an answer of the returned listener, which never comes.
pub fn server_that_is(state: &str) -> (Builder, Option<TcpListener>) {
    let builder = server_of(Webots::that_is(state), 1);
    if state != "checkingout" {
        return (builder, None);
    }
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let mirror = format!("https://127.0.0.1:{}/", listener.local_addr().unwrap().port());
    (
        builder.set("gitMirrors", serde_json::json!({"https://github.com/": mirror})),
        Some(listener),
    )
}

impl Builder {
    fn new(program: &'static str, config: Value, port: u16) -> Self {
        let name = program.rsplit('/').next().unwrap();
        // An unused display: sandboxes would otherwise get one that other tests start and end.
        let environment = vec![("DISPLAY".to_owned(), ":59000".to_owned())];
        Self {
            program,
            name,
            config,
            port,
            environment,
            folder: None,
            before: None,
            parts: None,
        }
    }

    pub fn forge(&self) -> &Forge {
        &self.parts.as_ref().unwrap().0
    }

    /// Sets a key of the configuration; `a.b` is the key `b` in the object `a`.
    pub fn set(mut self, key: &str, value: impl Into<Value>) -> Self {
        let pointer = key.split('.').fold(&mut self.config, |place, part| &mut place[part]);
        *pointer = value.into();
        self
    }

    /// Makes a session server send mails to an SMTP server on this machine.
    pub fn mails_to(self, port: u16) -> Self {
        let addressed = self
            .set("administrator", "admin@example.org")
            .set("mailSender", "fleet@example.org");
        addressed.set("mailServer", "127.0.0.1").set("mailServerPort", port)
    }

    /// Sets an environment variable.
    pub fn env(mut self, name: &str, value: &str) -> Self {
        self.environment.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Uses this port, for example to replace another server.
    pub fn port(mut self, port: u16) -> Self {
        self.port = port;
        self.set("port", port)
    }

    /// Uses a folder that outlives the server, so that another server can start in it.
    pub fn folder(mut self, folder: &Path) -> Self {
        self.folder = Some(folder.to_owned());
        self
    }

    /// Limits the open files of the server.
    pub fn files(self, most: u32) -> Self {
        self.before(&format!("ulimit -n {most}"))
    }

    /// Runs this in a shell that then becomes the server.
    pub fn before(mut self, script: &str) -> Self {
        self.before = Some(script.to_owned());
        self
    }

    /// Writes the configuration into a folder; returns the path of the file.
    pub fn write(&mut self, folder: &Path) -> PathBuf {
        for (key, name) in [("logDir", "log"), ("cacheDir", "cache")] {
            if self.config.get(key).is_none() && (key == "logDir" || self.name == "simulation-server") {
                self.config[key] = folder.join(name).to_str().unwrap().into();
            }
        }
        let file = folder.join("config.json");
        std::fs::write(&file, serde_json::to_string_pretty(&self.config).unwrap()).unwrap();
        file
    }

    /// Writes the configuration and starts the program, without waiting for it.
    pub fn spawn(mut self) -> Server {
        // Some tests with a thousand connections run in parallel with others.
        raise_file_limit();
        let temporary = self.folder.is_none().then(|| tempfile::tempdir().unwrap());
        let folder = self
            .folder
            .take()
            .unwrap_or_else(|| temporary.as_ref().unwrap().path().to_owned());
        let file = self.write(&folder);
        let log = File::options()
            .create(true)
            .append(true)
            .open(folder.join("output.txt"))
            .unwrap();
        let mut command = Command::new(if self.before.is_some() { "bash" } else { self.program });
        if let Some(script) = &self.before {
            command.args(["-c", &format!("{script}\nexec \"$0\" \"$@\""), self.program]);
        }
        let child = command
            .arg(&file)
            .envs(self.environment)
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .spawn()
            .unwrap();
        Server {
            child,
            folder,
            port: self.port,
            name: self.name,
            is_upgraded: Cell::new(false),
            _temporary: temporary,
            _parts: self.parts,
        }
    }

    /// Starts the program, which must end with this exit code and one error line. It may print log lines too, but none
    /// if the code is that of a wrong configuration. Returns the error line.
    pub async fn refused(self, code: i32) -> String {
        let mut server = self.spawn();
        assert_eq!(server.ended().await, Some(code), "{}", server.log());
        let log = server.log();
        let told: Vec<&str> = log.lines().filter(|line| line.starts_with("error: ")).collect();
        let logged = log.lines().filter(|line| code != 2 && line.starts_with("20")).count();
        assert!(told.len() == 1 && log.lines().count() == 1 + logged, "{log}");
        told[0].to_owned()
    }

    /// Starts the program and waits until it answers.
    pub async fn start(self) -> Server {
        let mut server = self.spawn();
        let answers = holds_soon(async || {
            assert!(server.child.try_wait().unwrap().is_none(), "{} has ended", server.name);
            http::try_get(&server.url("/health")).await.is_ok()
        });
        assert!(answers.await, "{} does not answer", server.name);
        server
    }
}

impl Server {
    /// The forge of a server of [`server_of`].
    pub fn forge(&self) -> &Forge {
        &self._parts.as_ref().unwrap().0
    }

    pub fn cache(&self) -> PathBuf {
        self.folder.join("cache")
    }

    /// `HOST:PORT`.
    pub fn address(&self) -> String {
        format!("127.0.0.1:{}", self.port)
    }

    pub fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address())
    }

    pub fn websocket(&self, path: &str) -> String {
        format!("ws://{}{path}", self.address())
    }

    pub fn pid(&self) -> i32 {
        i32::try_from(self.child.id()).unwrap()
    }

    /// The direct child processes.
    pub fn children(&self) -> Vec<i32> {
        let all = procfs::process::all_processes().unwrap().flatten();
        all.filter(|one| one.stat().is_ok_and(|stat| stat.ppid == self.pid()))
            .map(|one| one.pid())
            .collect()
    }

    /// The child process that ends the simulations if the server dies.
    pub fn guardian(&self) -> i32 {
        let words = |pid: &i32| {
            procfs::process::Process::new(*pid)
                .and_then(|one| one.cmdline())
                .unwrap_or_default()
        };
        self.children()
            .into_iter()
            .find(|pid| words(pid).get(1).is_some_and(|word| word == "guard"))
            .unwrap()
    }

    /// Sends a signal to the server itself.
    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.pid()), signal).unwrap();
    }

    /// Sends SIGTERM, and checks that the server exits with code 0.
    pub async fn stops(&mut self) {
        self.signal(Signal::SIGTERM);
        assert_eq!(self.ended().await, Some(0));
    }

    /// `/status`, parsed.
    pub async fn status(&self) -> Value {
        http::get(&self.url("/status")).await.json()
    }

    /// The simulations in `/status`.
    pub async fn simulations(&self) -> Vec<Value> {
        self.status().await["simulations"].as_array().unwrap().clone()
    }

    /// Waits until this many simulations wait for their clients to resume them.
    pub async fn until_away(&self, count: usize) {
        let are_away = async || {
            self.simulations()
                .await
                .iter()
                .filter(|one| one["awayUntil"].is_u64())
                .count()
                == count
        };
        super::until(&format!("{count} are away"), are_away).await;
    }

    /// The text of `/metrics`.
    pub async fn metrics(&self) -> String {
        http::get(&self.url("/metrics")).await.text()
    }

    /// The HTML of `/monitor`.
    pub async fn monitor(&self) -> String {
        http::get(&self.url("/monitor")).await.text()
    }

    /// The status code and the text of `/health`.
    pub async fn health(&self) -> (u16, String) {
        let answer = http::try_get(&self.url("/health")).await.unwrap();
        (answer.status.as_u16(), answer.text())
    }

    /// Its exit code, once the server has ended.
    pub fn exit_code(&mut self) -> Option<i32> {
        self.child.try_wait().unwrap()?.code()
    }

    /// Has a simulation server start its program anew. Returns whether it did, and what was printed.
    pub async fn upgrade(&self) -> (bool, String) {
        self.is_upgraded.set(true);
        let mut command = tokio::process::Command::new(env!("CARGO_BIN_EXE_simulation-server"));
        let command = command.arg("upgrade").arg(self.folder.join("config.json"));
        let done = actix_rt::time::timeout(4 * super::SOON, command.output()).await;
        let done = done.expect("an upgrade ends").unwrap();
        let printed = [done.stdout, done.stderr].concat();
        (done.status.success(), String::from_utf8(printed).unwrap())
    }

    /// All processes that serve this configuration.
    pub fn processes(&self) -> Vec<i32> {
        let file = self.folder.join("config.json");
        let serves = |one: &procfs::process::Process| {
            let words = one.cmdline().unwrap_or_default();
            let is_server = words.first().is_some_and(|program| program.ends_with("-server"));
            is_server && words.get(1).is_some_and(|word| Path::new(word) == file)
        };
        let all = procfs::process::all_processes().unwrap().flatten();
        all.filter(serves).map(|one| one.pid()).collect()
    }

    /// Waits until the server has ended; returns its exit code.
    pub async fn ended(&mut self) -> Option<i32> {
        let ends = holds_soon(async || self.child.try_wait().unwrap().is_some()).await;
        assert!(ends, "{} does not end", self.name);
        self.child.wait().unwrap().code()
    }

    /// What the server has printed so far.
    pub fn log(&self) -> String {
        std::fs::read_to_string(self.folder.join("output.txt")).unwrap_or_default()
    }

    /// The output file of a running simulation.
    pub fn output_file(&self, client: &super::client::Client) -> PathBuf {
        self.folder
            .join(format!("log/simulation/instances/{}.log", client.id()))
    }

    /// Makes a server reload its configuration with these keys changed.
    pub fn reload(&self, keys: Value) {
        self.rewrite_config(|config| {
            config
                .as_object_mut()
                .unwrap()
                .extend(keys.as_object().unwrap().clone())
        });
        self.signal(Signal::SIGHUP);
    }

    /// Changes the server's configuration file.
    pub fn rewrite_config(&self, change: impl FnOnce(&mut Value)) {
        let file = self.folder.join("config.json");
        let mut config: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
        change(&mut config);
        std::fs::write(&file, config.to_string()).unwrap();
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
        if self.is_upgraded.get() {
            for later in self.processes() {
                kill(Pid::from_raw(later), Signal::SIGKILL).ok();
            }
        }
        if std::thread::panicking() {
            eprintln!("--- {} on port {} ---\n{}---", self.name, self.port, self.log());
        }
    }
}
