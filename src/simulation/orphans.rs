//! Processes that have lost their guardian: the server adopts them, ends them, and buries them.
//!
//! A guardian that is killed leaves its tree to the next 'child subreaper' above it, which is the server. Whatever is
//! then a child of the server, and was not started by it, is ended with all its descendants, however well it hides.
//! Each guardian leads a session of its own, which its tree can't leave for the server's: so orphans can be told from
//! helpers that libraries start and wait for.

use std::collections::BTreeSet;
use std::io;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use nix::sys::prctl;
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;
use procfs::process::Process;
use tokio::process::{Child, Command};
use tokio::signal::unix::{SignalKind, signal};

use super::{process_tree, x_lock};

/// Children that the server has started itself. One that has ended is forgotten when somebody looks.
static STARTED: Mutex<BTreeSet<i32>> = Mutex::new(BTreeSet::new());

/// One at a time ends orphans: who comes second finds all of it done.
static ENDING: Mutex<()> = Mutex::new(());

/// Between two looks at orphans that are ending.
const LOOK: Duration = Duration::from_millis(20);
/// From the end of a child to the look for orphans: many end in a busy second, and one look serves all.
const PAUSE: Duration = Duration::from_millis(50);
/// How long killed processes may take to vanish.
const VANISH: Duration = Duration::from_secs(10);

/// Makes this process the one that orphans below it go to.
///
/// # Errors
/// When the system can't do that.
pub fn adopt() -> io::Result<()> {
    Ok(prctl::set_child_subreaper(true)?)
}

/// Starts a child that is none of them.
///
/// # Errors
/// When the system can start no more processes.
pub fn start(command: &mut Command) -> io::Result<Child> {
    // Until it is known, nobody may look.
    let mut started = started();
    let child = command.spawn()?;
    started.extend(child.id().and_then(|id| i32::try_from(id).ok()));
    Ok(child)
}

/// Ends orphans whenever a child has ended, for ever.
///
/// # Errors
/// When the system does not tell of ended children.
pub async fn watch() -> io::Result<()> {
    let mut deaths = signal(SignalKind::child())?;
    while deaths.recv().await.is_some() {
        actix_rt::time::sleep(PAUSE).await;
        actix_rt::task::spawn_blocking(end_all).await.ok();
    }
    Ok(())
}

/// Ends all orphans, and waits until they have vanished. Waits: not for a thread that serves others.
pub fn end_all() {
    let _turn = ENDING.lock().unwrap_or_else(PoisonError::into_inner);
    let deadline = Instant::now() + VANISH;
    let mut ended = BTreeSet::new();
    while end(&mut ended) && Instant::now() < deadline {
        std::thread::sleep(LOOK);
    }
    if !ended.is_empty() {
        log::warn!("ended {} processes that had lost their guardian", ended.len());
        x_lock::remove_of(&ended);
    }
}

/// Ends orphans, or buries them. Gives back whether some have not vanished yet.
fn end(ended: &mut BTreeSet<i32>) -> bool {
    let mut is_left = false;
    for pid in orphans() {
        if let Ok(WaitStatus::StillAlive) = waitpid(Pid::from_raw(pid), Some(WaitPidFlag::WNOHANG)) {
            ended.extend(process_tree::kill_tree(pid));
            is_left = true;
        }
    }
    is_left
}

fn orphans() -> Vec<i32> {
    let mut started = started();
    let children: BTreeSet<i32> = process_tree::children(std::process::id().cast_signed()).into_iter().collect();
    started.retain(|pid| children.contains(pid));
    let Ok(own) = Process::myself().and_then(|process| process.stat()) else {
        return Vec::new();
    };
    let is_foreign = |pid: &i32| {
        let stat = Process::new(*pid).and_then(|process| process.stat());
        stat.is_ok_and(|stat| (stat.pgrp, stat.session) != (own.pgrp, own.session))
    };
    children.into_iter().filter(|pid| !started.contains(pid)).filter(is_foreign).collect()
}

/// A list of numbers is right even if a thread has panicked that held it.
fn started() -> MutexGuard<'static, BTreeSet<i32>> {
    STARTED.lock().unwrap_or_else(PoisonError::into_inner)
}
