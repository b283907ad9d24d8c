//! A process beside the server that ends the simulations when the server has exited, for any reason.
//!
//! The server starts its own program once more, as `simulation-server guard FOLDER` with the directory of this run. The
//! guardian reads its standard input, a pipe whose other end only the server holds. The kernel closes that end when the
//! server exits, also after SIGKILL. Then the guardian does at once what the next start of the server would do: it
//! kills every process with the mark of this run (see [`process_tree::MARK`]), and removes the directory. After an
//! orderly stop there is nothing left to do.
//!
//! A child that the server has just forked holds that end as well, until `execve`, and has the mark from then on: one
//! pass is enough. A guardian that exits before the server is not replaced: the next start of the server does its work.
//!
//! At level `none` the simulations have the guardian's user, and can signal it. The server continues one that is
//! stopped, at most a second later.

use std::convert::Infallible;
use std::future::pending;
use std::io::PipeWriter;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use nix::sys::signal::{SigSet, Signal, kill};
use nix::sys::wait::{Id, WaitPidFlag, WaitStatus, waitid};
use nix::unistd::{Pid, setsid};

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

/// Interval between two looks at the guardian.
const LOOK: Duration = Duration::from_secs(1);

/// A running guardian. It acts when this handle is dropped.
pub struct Guardian {
    pid: Pid,
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
            pid: Pid::from_raw(child.id().cast_signed()),
            _lifeline: lifeline,
        })
    }

    /// Continues the guardian whenever a program has stopped it, and logs that, or its end.
    pub async fn watch(&self) -> Infallible {
        // It remains a zombie, so that its process id is not given to another process.
        let look = WaitPidFlag::WSTOPPED | WaitPidFlag::WEXITED | WaitPidFlag::WNOHANG | WaitPidFlag::WNOWAIT;
        loop {
            actix_rt::time::sleep(LOOK).await;
            match waitid(Id::Pid(self.pid), look) {
                Ok(WaitStatus::Stopped(..)) => {
                    log::error!("a program has stopped the guardian of the simulations; it is continued");
                    self.go_on();
                }
                Ok(WaitStatus::Exited(..) | WaitStatus::Signaled(..)) => {
                    log::error!(
                        "the guardian of the simulations has ended: if this server is killed, they live on until its next start"
                    );
                    return pending().await;
                }
                _ => {}
            }
        }
    }

    fn go_on(&self) {
        kill(self.pid, Signal::SIGCONT).ok();
    }
}

impl Drop for Guardian {
    fn drop(&mut self) {
        self.go_on();
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
