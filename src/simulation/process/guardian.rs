//! A process beside the server that ends the simulations when the server is gone, in whatever way.
//!
//! The server starts its own program once more, as `simulation-server guard FOLDER` with the folder of this run. The
//! guardian reads its standard input, a pipe whose other end only the server holds. The kernel closes that end when the
//! server has ended, also after SIGKILL. Then the guardian kills every process that carries the mark of this run (see
//! [`process_tree::MARK`]), and removes the folder. After an orderly stop it finds nothing left to do.
//!
//! If server and guardian are killed together, the next start of the server does the same.

use std::io::PipeWriter;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use nix::sys::signal::{SigSet, Signal};
use nix::unistd::setsid;

use super::instance_dir::remove_patiently;
use super::process_tree;

/// How long the guardian looks for processes that the server was starting as it ended: a process has the mark only once
/// it executes its program (`execve`), which takes a while on a busy machine.
const LATECOMERS: Duration = Duration::from_millis(500);

/// The command line of a guardian.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Folder of the run
    folder: PathBuf,
    /// Whose containers are removed
    #[arg(long)]
    pub containers: Option<String>,
}

/// A running guardian. It acts when this is dropped.
#[derive(Debug)]
pub struct Guardian {
    _lifeline: PipeWriter,
}

impl Guardian {
    /// Starts a guardian for the run that has this folder; `containers` is whose containers it removes too.
    ///
    /// # Errors
    /// When the system can start no more processes.
    pub fn start(run: &Path, containers: Option<&str>) -> std::io::Result<Self> {
        let (reader, lifeline) = std::io::pipe()?;
        let mut command = tokio::process::Command::new("/proc/self/exe");
        command.arg0("simulation-server").arg("guard").arg(run);
        command.args(containers.map(|owner| format!("--containers={owner}")));
        command.stdin(reader).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
        Ok(Self { _lifeline: lifeline })
    }
}

/// What the guardian process does, from its start to its end; `remove` removes what is not a process. Returns its exit
/// code.
#[must_use]
pub fn guard(arguments: &Arguments, remove: impl FnOnce()) -> u8 {
    // A signal to the server's group, or Ctrl-C in its terminal, must not end the guardian before the server.
    if let Err(error) = setsid().and_then(|_| block_signals()) {
        eprintln!("can't get out of the reach of the server's signals: {error}");
        return 1;
    }
    std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink()).ok();
    let end = Instant::now() + LATECOMERS;
    while Instant::now() < end {
        process_tree::kill_marked(&arguments.folder);
    }
    remove();
    remove_patiently(&arguments.folder);
    0
}

fn block_signals() -> nix::Result<()> {
    let blocked: SigSet = [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP].into_iter().collect();
    blocked.thread_block()
}
