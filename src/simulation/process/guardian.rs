//! A small process between the server and a program that it starts: it outlives neither.
//!
//! The server starts itself as `simulation-server guard -- PROGRAM ARGUMENTS...` for each program. The guardian
//!
//! - adopts whatever the program leaves behind (a 'child subreaper'), so that the whole tree stays known, also where
//!   a process leaves its group or loses its parent;
//! - reads its standard input, the lifeline. A byte on it asks for an orderly end: SIGTERM to the group, a grace time,
//!   SIGKILL. Its end means that the server is gone, in whatever way: SIGKILL at once;
//! - ends the rest of the tree when the program itself ends, removes the instance's folder when asked to, and passes
//!   the program's exit code on (128 + N for signal N, as shells do).
//!
//! One more guardian, without a program, ends processes that have lost both server and guardian, and removes the folder
//! of the run.
//!
//! It is synchronous: three threads that wait, and nothing else.

use std::collections::BTreeSet;
use std::io::Read;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::sys::prctl;
use nix::sys::signal::{SigSet, Signal, killpg};
use nix::sys::wait::{WaitStatus, waitpid};
use nix::unistd::{Pid, setsid};

use super::instance_dir::{remove, remove_patiently};
use super::{process_tree, x_lock};

/// What a guardian is told on its command line.
#[derive(Debug, clap::Args)]
pub struct Orders {
    /// Time between SIGTERM and SIGKILL, in milliseconds
    #[arg(long, default_value_t = 5000)]
    grace: u64,
    /// Folder to remove at the end
    #[arg(long)]
    remove: Option<PathBuf>,
    /// Program to start, and its arguments; without one it only waits for the server's end, and removes the folder
    #[arg(last = true)]
    command: Vec<std::ffi::OsString>,
}

/// Exit code when the program can't be started, as shells have it.
pub const NOT_STARTED: u8 = 127;
/// How long killed processes may take to vanish.
const VANISH: Duration = Duration::from_secs(10);

enum Event {
    /// The server asks for an orderly end.
    Stop,
    /// The server is gone.
    Lost,
    /// The program itself has ended, with this code.
    Ended(u8),
    /// No process of the tree is left.
    Empty,
}

/// Guards one program until it has ended; gives back its exit code.
#[must_use]
pub fn guard(orders: &Orders) -> u8 {
    let code = run(orders).unwrap_or_else(|problem| {
        eprintln!("{problem}");
        NOT_STARTED
    });
    if let Some(folder) = &orders.remove {
        // The server removes it too, if it still lives.
        if orders.command.is_empty() { end_run(folder) } else { remove(folder) }
    }
    code
}

/// Ends what is left of a server's run. Its folder goes last: by it a later server would know whom to end.
fn end_run(folder: &Path) {
    process_tree::await_guardians(folder);
    // None where the server has ended in order, or each guardian has done its work.
    let _count = process_tree::kill_marked(folder);
    remove_patiently(folder);
}

fn run(orders: &Orders) -> Result<u8, String> {
    // Nothing of the program's can come back into the server's session: by that the server knows its own children.
    setsid().map_err(|error| format!("can't lead a session: {error}"))?;
    let Some((program, arguments)) = orders.command.split_first() else {
        become_deaf()?;
        std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink()).ok();
        return Ok(0);
    };
    prctl::set_child_subreaper(true).map_err(|error| format!("can't adopt orphans: {error}"))?;
    let child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .process_group(0)
        .spawn()
        .map_err(|error| format!("{} can't be started: {error}", program.display()))?;
    // The program itself has inherited no blocked signal.
    become_deaf()?;
    let group = Pid::from_raw(i32::try_from(child.id()).map_err(|error| error.to_string())?);
    let (sender, events) = channel();
    let lifeline = sender.clone();
    std::thread::spawn(move || watch_lifeline(&lifeline));
    std::thread::spawn(move || reap(group, &sender));
    let (code, rest) = supervise(&events, group, Duration::from_millis(orders.grace));
    if rest == Rest::Unknown {
        end_tree(&events);
    }
    Ok(code)
}

/// It is the server who decides when a guardian ends.
fn become_deaf() -> Result<(), String> {
    let deaf_to: SigSet = [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP].into_iter().collect();
    deaf_to.thread_block().map_err(|error| format!("can't block signals: {error}"))
}

/// What is left of a tree.
#[derive(PartialEq, Eq)]
enum Rest {
    Nothing,
    Unknown,
}

/// Waits for the end of the program, or for what ends it. Gives back the exit code.
fn supervise(events: &Receiver<Event>, group: Pid, grace: Duration) -> (u8, Rest) {
    let mut deadline: Option<Instant> = None;
    let mut code = 128 + 9;
    loop {
        let patience = deadline.map_or(VANISH, |end| end.saturating_duration_since(Instant::now()));
        match events.recv_timeout(patience) {
            Ok(Event::Stop) if deadline.is_none() => {
                deadline = Some(Instant::now() + grace);
                killpg(group, Signal::SIGTERM).ok();
            }
            // A program that was asked to end may leave children that are still ending, within the same grace time.
            Ok(Event::Ended(ended)) => {
                code = ended;
                if deadline.is_none() {
                    return (code, Rest::Unknown);
                }
            }
            Ok(Event::Stop) => {}
            Err(RecvTimeoutError::Timeout) if deadline.is_none() => {}
            // It is told once only: who waited for it again would wait in vain.
            Ok(Event::Empty) => return (code, Rest::Nothing),
            Ok(Event::Lost) | Err(_) => return (code, Rest::Unknown),
        }
    }
}

/// Ends what is left of the tree, and waits until it has vanished.
fn end_tree(events: &Receiver<Event>) {
    let end = Instant::now() + VANISH;
    let own = i32::try_from(std::process::id()).unwrap_or_default();
    let mut pause = Duration::from_millis(1);
    let mut killed = BTreeSet::new();
    while Instant::now() < end {
        killed.extend(process_tree::kill_descendants(own));
        match events.recv_timeout(pause) {
            Ok(Event::Empty) | Err(RecvTimeoutError::Disconnected) => return x_lock::remove_of(&killed),
            Ok(_) | Err(RecvTimeoutError::Timeout) => pause = (pause * 2).min(Duration::from_millis(100)),
        }
    }
    eprintln!("some processes can't be ended");
}

fn watch_lifeline(events: &Sender<Event>) {
    for byte in std::io::stdin().lock().bytes() {
        if byte.is_err() || events.send(Event::Stop).is_err() {
            break;
        }
    }
    events.send(Event::Lost).ok();
}

fn reap(leader: Pid, events: &Sender<Event>) {
    loop {
        let ended = match waitpid(None, None) {
            Ok(WaitStatus::Exited(pid, code)) if pid == leader => Event::Ended(u8::try_from(code & 0xff).unwrap_or(1)),
            Ok(WaitStatus::Signaled(pid, signal, _)) if pid == leader => {
                Event::Ended(128 + u8::try_from(signal as i32).unwrap_or_default())
            }
            Ok(_) | Err(Errno::EINTR) => continue,
            Err(_) => Event::Empty,
        };
        let last = matches!(ended, Event::Empty);
        if events.send(ended).is_err() || last {
            return;
        }
    }
}
