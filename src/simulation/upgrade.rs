//! An upgrade, as the process sees it that has the port: it starts its program anew, which may have been replaced, and
//! hands over once that is ready. Until then nothing has changed: if the new one can't start, this one goes on.
//!
//! Also answers what else a process is asked over its socket `control`.

use std::ffi::OsString;
use std::fs::File;
use std::io;
use std::net::TcpListener;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixListener;
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use actix_rt::time::timeout;
use actix_web::dev::ServerHandle;
use tokio::io::{BufReader, Interest};
use tokio::net::UnixStream;
use tokio::process::Command;
use tokio::sync::Mutex;
use tokio::sync::mpsc::UnboundedSender;

use super::config::SimulationConfig;
use super::handover::control::{self, ForwardedStop, Reply, Request, read, write};
use super::handover::{PROTOCOL, TAKES_OVER, Takeover, ToPredecessor, ToSuccessor};
use super::run_id::RunId;
use super::state::AppState;
use crate::shared::run::{Phase, ServerCommand, passing, service_manager};

/// What the next process gets.
pub struct Estate {
    /// The listening socket.
    pub listener: TcpListener,
    /// Locks `cacheDir`, until it is handed over.
    pub lock: Option<File>,
    /// Locked while the server runs, until it is handed over.
    pub pid_file: Option<File>,
    /// The secret that signs administrators' sign-ins.
    pub sign_in: String,
}

/// Answers at the socket `control`.
pub struct Control {
    /// The server.
    pub server: Arc<AppState>,
    /// `cacheDir`.
    pub cache: PathBuf,
    /// What the next process gets. An upgrade holds its lock.
    pub estate: Mutex<Estate>,
    /// The web server of the port.
    pub port: ServerHandle,
    /// Whether what is for nobody else goes to another process.
    pub has_moved: Arc<AtomicBool>,
    /// Receives commands for this process.
    pub commands: UnboundedSender<ServerCommand>,
}

/// Time in which the new process must be ready.
const START: Duration = Duration::from_secs(20);
/// Time for the requests that have come before the port is handed over.
const REST: Duration = Duration::from_millis(200);
/// Pause after a connection that can't be accepted.
const PAUSE: Duration = Duration::from_millis(100);
/// Timeout of a request.
const REQUEST: Duration = Duration::from_secs(5);
/// Timeout of a whole upgrade, for whoever asks for it: a check, a start, and a moment.
const UPGRADE: Duration = Duration::from_secs(50);

/// Has the server with this configuration upgraded. Returns what has happened. Blocks.
///
/// # Errors
/// Why it goes on as it was, as text for an administrator.
pub fn request(config: &SimulationConfig) -> Result<String, String> {
    let serving = control::serving(&config.cache_dir.0);
    let asked = actix_rt::System::new().block_on(control::ask(&serving, &Request::Upgrade, UPGRADE));
    match asked {
        Ok(Reply::Done(what)) => Ok(what),
        Ok(Reply::Failed(why)) => Err(format!("the server goes on as it was: {why}")),
        Ok(Reply::Holdings(_)) => Err("the server has answered something else".to_owned()),
        Err(error) => Err(format!(
            "no server with this configuration answers in {}: {error}",
            serving.display()
        )),
    }
}

impl Control {
    /// Answers for ever.
    ///
    /// # Errors
    /// When the socket can't be used.
    pub async fn serve(self: Arc<Self>, listener: UnixListener) -> io::Result<()> {
        listener.set_nonblocking(true)?;
        let listener = tokio::net::UnixListener::from_std(listener)?;
        loop {
            match listener.accept().await {
                Ok((socket, _)) => {
                    let this = Arc::clone(&self);
                    actix_rt::spawn(async move {
                        if let Err(error) = this.answer(socket).await {
                            log::warn!("a request of another process is not answered: {error}");
                        }
                    });
                }
                // Too many open files, for a moment.
                Err(_) => actix_rt::time::sleep(PAUSE).await,
            }
        }
    }

    async fn answer(&self, socket: UnixStream) -> io::Result<()> {
        let mut socket = BufReader::new(socket);
        let reply = match timeout(REQUEST, read(&mut socket)).await? {
            Ok(Request::Look) => Reply::Holdings(self.server.slots.give_up_free()),
            Ok(Request::Stop(ForwardedStop { ids, reason, by })) => {
                Reply::Done(self.server.stop_here(&ids, &reason, &by).join(" "))
            }
            Ok(Request::End) => {
                // The server may be ending already.
                self.commands.send(ServerCommand::Stop).ok();
                Reply::Done(String::new())
            }
            Ok(Request::Upgrade) => match self.upgrade().await {
                Ok(what) => Reply::Done(what),
                Err(why) => {
                    log::error!("no other process takes over: {why}");
                    Reply::Failed(why)
                }
            },
            Ok(Request::Listener) => return self.pass_listener(&socket.into_inner()).await,
            Err(error) => Reply::Failed(error.to_string()),
        };
        write(&mut socket, &reply).await
    }

    async fn pass_listener(&self, socket: &UnixStream) -> io::Result<()> {
        if *self.server.phase.borrow() != Phase::Superseded {
            return Ok(());
        }
        let listener = self.estate.lock().await.listener.try_clone()?;
        let sent = socket.async_io(Interest::WRITABLE, || passing::send(socket, b"\n", &[listener.as_fd()]));
        sent.await.map(drop)
    }

    /// Starts the program anew and hands over to it. Returns what has happened.
    async fn upgrade(&self) -> Result<String, String> {
        let Ok(mut estate) = self.estate.try_lock() else {
            return Err("another upgrade is at work".to_owned());
        };
        self.must_be_open()?;
        check().await?;
        let channel = launch(&estate)
            .await
            .map_err(|error| format!("no process can be started: {error}"))?;
        let mut channel = BufReader::new(channel);
        let answer = timeout(START, read(&mut channel)).await;
        let (run, pid) = match answer {
            Ok(Ok(ToPredecessor::Ready { run, pid })) => (run, pid),
            Ok(Ok(ToPredecessor::Failed(why))) => return Err(why),
            Ok(Err(_)) => {
                return Err("the new process has ended before it was ready; what it printed says why".to_owned());
            }
            Err(_) => return Err(format!("the new process was not ready within {} s", START.as_secs())),
        };
        self.must_be_open()?;
        control::set_serving(&self.cache, run).map_err(|error| unwritable(&error))?;
        self.has_moved.store(true, Relaxed);
        self.port.pause().await;
        // New requests wait for the new process. Those that have come before are answered as ever.
        actix_rt::time::sleep(REST).await;
        if !self.server.leave_open(Phase::Superseded) {
            // A stop or a drain came meanwhile. The new process ends, as the channel to it closes.
            self.has_moved.store(false, Relaxed);
            self.port.resume().await;
            control::set_serving(&self.cache, RunId::own()).map_err(|error| unwritable(&error))?;
            return Err(refusal(*self.server.phase.borrow()).unwrap_or_default().to_owned());
        }
        let left = self.server.slots.supersede();
        let count = left.simulations.len();
        service_manager::main_process(pid);
        estate.lock = None;
        estate.pid_file = None;
        let what = format!(
            "process {pid} has the port; process {} serves its {count} simulations until their clients leave",
            std::process::id()
        );
        log::info!("{what}");
        // If the new one has ended, a crash ends it as at any other time.
        write(&mut channel, &ToSuccessor(left)).await.ok();
        Ok(what)
    }

    fn must_be_open(&self) -> Result<(), String> {
        match refusal(*self.server.phase.borrow()) {
            None => Ok(()),
            Some(why) => Err(why.to_owned()),
        }
    }
}

/// Why a server in this phase is not upgraded; `None` if it is.
fn refusal(phase: Phase) -> Option<&'static str> {
    match phase {
        Phase::Open => None,
        Phase::Draining => Some("it drains, and ends after its last simulation"),
        Phase::Superseded => Some("another process has its port already"),
        Phase::Closing => Some("it stops"),
    }
}

fn unwritable(error: &io::Error) -> String {
    format!("cacheDir can't be written: {error}")
}

/// The program and its arguments, as this process was started.
fn command_line() -> (OsString, Vec<OsString>) {
    let mut words = std::env::args_os();
    let program = words.next().unwrap_or_default();
    (program, words.filter(|word| word != TAKES_OVER).collect())
}

/// Has the new program check the configuration.
async fn check() -> Result<(), String> {
    let (program, arguments) = command_line();
    let mut command = Command::new(&program);
    command
        .args(arguments)
        .arg("--check")
        .stdin(Stdio::null())
        .kill_on_drop(true);
    let done = timeout(START, command.output()).await;
    let done = done.map_err(|_| format!("{} --check does not end", program.display()))?;
    let done = done.map_err(|error| format!("{} can't be started: {error}", program.display()))?;
    if done.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&done.stderr);
    let errors: Vec<&str> = said.lines().filter_map(|line| line.strip_prefix("error: ")).collect();
    Err(format!("{} --check fails: {}", program.display(), errors.join("; ")))
}

/// Starts the new process with what it gets. Returns the other end of its standard input.
async fn launch(estate: &Estate) -> io::Result<UnixStream> {
    let (own, theirs) = std::os::unix::net::UnixStream::pair()?;
    let passed = Takeover {
        protocol: PROTOCOL,
        run: RunId::own(),
        sign_in: estate.sign_in.clone(),
    };
    let line = serde_json::to_string(&passed)? + "\n";
    let locks = estate.lock.iter().chain(&estate.pid_file).map(AsFd::as_fd);
    let files: Vec<_> = std::iter::once(estate.listener.as_fd()).chain(locks).collect();
    passing::send(&own, line.as_bytes(), &files)?;
    let (program, arguments) = command_line();
    // It is no child of this process, which may end before it: the service manager, or init, learns of its end.
    let mut command = Command::new("setsid");
    command.arg("--fork").arg(program).args(arguments).arg(TAKES_OVER);
    // The watchdog of the service manager is for the main process.
    command.env_remove("WATCHDOG_PID").stdin(OwnedFd::from(theirs));
    let status = command.status().await?;
    drop(command);
    if !status.success() {
        return Err(io::Error::other(format!("setsid: {status}")));
    }
    own.set_nonblocking(true)?;
    UnixStream::from_std(own)
}
