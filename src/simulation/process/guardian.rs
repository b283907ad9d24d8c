//! A process beside the server that ends the simulations when the server has exited, for any reason.
//!
//! The server starts its own program once more, as `simulation-server guard FOLDER` with the directory of this run. The
//! guardian reads its standard input, a pipe whose other end only the server holds. The kernel closes that end when the
//! server exits, also after SIGKILL. Then the guardian does at once what the next start of the server would do: it
//! kills every process with the mark of this run (see [`process_tree::MARK`]), and removes the directory. After an
//! orderly stop there is nothing left to do.
//!
//! A child that the server has just forked holds that end as well, until `execve`, and has the mark from then on: one
//! pass is enough. The guardian is not supervised: if it exits before the server, the next start of the server does its
//! work.

use std::io::PipeWriter;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use nix::sys::signal::{SigSet, Signal};
use nix::unistd::setsid;

use super::{instance_dir, process_tree};

/// The command line of a guardian.
#[derive(Debug, clap::Args)]
pub struct Arguments {
    /// Directory of the run
    folder: PathBuf,
    /// Owner of the containers to remove
    #[arg(long)]
    pub containers: Option<String>,
}

/// A running guardian. It acts when this handle is dropped.
pub struct Guardian {
    _child: Child,
    _lifeline: PipeWriter,
}

impl Guardian {
    /// Starts a guardian for the run with this directory; `containers` names the owner whose containers it removes too.
    ///
    /// # Errors
    /// When the system can start no more processes.
    pub fn start(run: &Path, containers: Option<&str>) -> std::io::Result<Self> {
        let (reader, lifeline) = std::io::pipe()?;
        let mut command = Command::new("/proc/self/exe");
        std::os::unix::process::CommandExt::arg0(&mut command, "simulation-server")
            .arg("guard")
            .arg(run);
        command.args(containers.map(|owner| format!("--containers={owner}")));
        let child = command
            .stdin(reader)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        Ok(Self {
            _child: child,
            _lifeline: lifeline,
        })
    }
}

/// The main function of the guardian process; `remove` removes what is not a process. Returns its exit code.
pub fn guard(arguments: &Arguments, remove: impl Fn()) -> u8 {
    // A signal to the server's group, or Ctrl-C in its terminal, must not end the guardian before the server.
    let signals: SigSet = [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP].into_iter().collect();
    if let Err(error) = setsid().and_then(|_| signals.thread_block()) {
        eprintln!("can't get out of the reach of the server's signals: {error}");
        return 1;
    }
    std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink()).ok();
    process_tree::kill_marked(&arguments.folder);
    remove();
    instance_dir::remove(&arguments.folder);
    0
}
