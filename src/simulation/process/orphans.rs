//! Processes that have lost their guardian: the server adopts them, ends them, and buries them.
//!
//! A guardian that is killed leaves its tree to the next 'child subreaper' above it, which is the server. Whatever is
//! then a child of the server, and was not started by it, is ended with all its descendants, however well it hides.
//! Each guardian leads a session of its own, which its tree can't leave for the server's: so orphans can be told from
//! helpers that libraries start and wait for.
//!
//! What git has started and left where it runs without a guardian is in the server's session: that is ended too, and is
//! nothing to tell of.
//!
//! Others may leave orphans to the server too: children that it had before it became this program (of a shell that has
//! started them, and then the server in its place), and everybody where it is the first process of a container. Such
//! children are never ended. Where there are such, an orphan is ended only if it is known to come from a guardian: it
//! carries the mark, or it was seen below a guardian by a look that is then taken each second. So a process that drops
//! its environment within a second before its guardian is killed may be overlooked there, and only there.

use std::collections::BTreeSet;
use std::io;
use std::sync::{LazyLock, Mutex, MutexGuard, OnceLock, PoisonError};
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

/// A process; its number alone may be given to another one later.
type Identity = (i32, u64);

/// Children that the server had before it started any: none of them was left by a guardian.
static EARLIER: OnceLock<BTreeSet<Identity>> = OnceLock::new();

/// Whether others than guardians may leave orphans to the server.
static HAS_STRANGERS: LazyLock<bool> =
    LazyLock::new(|| std::process::id() == 1 || EARLIER.get().is_some_and(|earlier| !earlier.is_empty()));

/// Processes that were below a guardian at the last look; kept only where there may be strangers.
static SEEN: Mutex<BTreeSet<Identity>> = Mutex::new(BTreeSet::new());

/// One at a time ends orphans: who comes second finds all of it done.
static ENDING: Mutex<()> = Mutex::new(());

/// Between two looks at orphans that are ending.
const LOOK: Duration = Duration::from_millis(20);
/// Between two looks at what is below guardians, where there may be strangers.
const ROUND: Duration = Duration::from_secs(1);
/// From the end of a child to the look for orphans: many end in a busy second, and one look serves all.
const PAUSE: Duration = Duration::from_millis(50);
/// How long killed processes may take to vanish.
const VANISH: Duration = Duration::from_secs(10);

/// Makes this process the one that orphans below it go to. For the start: children that are there already are spared.
///
/// # Errors
/// When the system can't do that.
pub fn adopt() -> io::Result<()> {
    let children = process_tree::children(own_pid());
    EARLIER.get_or_init(|| children.into_iter().filter_map(identity).collect());
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
    let mut round = actix_rt::time::interval(ROUND);
    loop {
        tokio::select! {
            death = deaths.recv() => {
                if death.is_none() {
                    return Ok(());
                }
                actix_rt::time::sleep(PAUSE).await;
                actix_rt::task::spawn_blocking(end_all).await.ok();
            }
            _ = round.tick(), if *HAS_STRANGERS => {
                actix_rt::task::spawn_blocking(look_below_guardians).await.ok();
            }
        }
    }
}

/// Ends all orphans, and waits until they have vanished. Waits: not for a thread that serves others.
pub fn end_all() {
    let turn = ENDING.lock().unwrap_or_else(PoisonError::into_inner);
    let deadline = Instant::now() + VANISH;
    let mut ended = BTreeSet::new();
    while end(&mut ended) && Instant::now() < deadline {
        std::thread::sleep(LOOK);
    }
    drop(turn);
    if !ended.is_empty() {
        log::warn!("ended {} processes that had lost their guardian", ended.len());
        x_lock::remove_of(&ended);
    }
}

/// Remembers what is below guardians now, and forgets what has ended.
fn look_below_guardians() {
    let guardians: Vec<i32> = started().iter().copied().collect();
    let below = guardians.into_iter().flat_map(process_tree::descendants).filter_map(identity);
    let below: BTreeSet<Identity> = below.collect();
    let mut seen = SEEN.lock().unwrap_or_else(PoisonError::into_inner);
    seen.retain(|one| identity(one.0) == Some(*one));
    seen.extend(below);
}

/// Whether an orphan is a guardian's.
fn is_ours(pid: i32) -> bool {
    let Some(one) = identity(pid) else {
        return false;
    };
    let is_earlier = EARLIER.get().is_some_and(|earlier| earlier.contains(&one));
    let was_seen = || SEEN.lock().unwrap_or_else(PoisonError::into_inner).contains(&one);
    !is_earlier && (!*HAS_STRANGERS || process_tree::is_marked(pid) || was_seen())
}

fn identity(pid: i32) -> Option<Identity> {
    let stat = Process::new(pid).and_then(|process| process.stat()).ok()?;
    Some((pid, stat.starttime))
}

/// Whether a process is in the server's session, where nothing can be that a guardian has started.
fn is_in_own_session(pid: i32) -> bool {
    let session =
        |process: procfs::ProcResult<Process>| process.and_then(|process| process.stat()).map(|stat| stat.session);
    matches!((session(Process::new(pid)), session(Process::myself())), (Ok(its), Ok(own)) if its == own)
}

fn own_pid() -> i32 {
    std::process::id().cast_signed()
}

/// Ends orphans, or buries them, and adds those that had a guardian. Gives back whether some have not vanished yet.
fn end(ended: &mut BTreeSet<i32>) -> bool {
    let mut is_left = false;
    for pid in orphans() {
        if let Ok(WaitStatus::StillAlive) = waitpid(Pid::from_raw(pid), Some(WaitPidFlag::WNOHANG))
            && is_ours(pid)
        {
            let had_guardian = !is_in_own_session(pid);
            let tree = process_tree::kill_tree(pid);
            if had_guardian {
                ended.extend(tree);
            }
            is_left = true;
        }
    }
    is_left
}

/// Children that the server has not started, strangers among them.
fn orphans() -> Vec<i32> {
    let mut started = started();
    let children: BTreeSet<i32> = process_tree::children(own_pid()).into_iter().collect();
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
