//! The folders of running simulations: guards whose drop removes them, and records by which a later run of the server
//! finds what an earlier one left.

use std::fs::{File, Permissions, TryLockError};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::process_tree;

/// The folder of one run of the server. It holds a folder for each simulation, and a lock that ends with the process,
/// however that ends.
#[derive(Debug)]
pub struct RunDir {
    folder: PathBuf,
    _lock: File,
}

/// The folder of one simulation. Dropping it removes it with everything inside.
#[derive(Debug)]
pub struct InstanceDir {
    folder: PathBuf,
}

/// What an earlier run had left.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Swept {
    /// Runs that had ended without removing their folder.
    pub runs: usize,
    /// Processes of theirs that were still alive.
    pub processes: usize,
}

const LOCK: &str = "lock";
/// How long others may take for their start; it takes milliseconds.
const TURN: Duration = Duration::from_secs(10);
/// Between two looks whether it is this server's turn.
const LOOK: Duration = Duration::from_millis(5);
/// Between two tries to remove a folder; then it is left to the next start.
const PAUSES: [Duration; 6] = [
    Duration::from_millis(20),
    Duration::from_millis(200),
    Duration::from_secs(1),
    Duration::from_secs(4),
    Duration::from_secs(15),
    Duration::from_secs(40),
];

impl RunDir {
    /// Makes the folder of this run below `cache`, and removes what dead runs have left there.
    ///
    /// # Errors
    /// When the folder can't be made.
    pub fn open(cache: &Path) -> io::Result<(Self, Swept)> {
        let runs = cache.join("runs");
        std::fs::create_dir_all(&runs)?;
        // Marks of processes are compared with this path: it must be the one without links.
        let runs = runs.canonicalize()?;
        let turn = take_turn(&runs)?;
        let dead = dead(&runs);
        let folder = tempfile::Builder::new().prefix("run-").tempdir_in(&runs)?.keep();
        let lock = File::create(folder.join(LOCK))?;
        lock.lock()?;
        drop(turn);
        Ok((Self { folder, _lock: lock }, sweep(&dead)))
    }

    /// Makes a folder for a simulation.
    ///
    /// # Errors
    /// When the folder can't be made.
    pub fn instance(&self) -> io::Result<InstanceDir> {
        let folder = tempfile::Builder::new().prefix("instance-").tempdir_in(&self.folder)?.keep();
        Ok(InstanceDir { folder })
    }

    /// The folder itself.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.folder
    }
}

impl RunDir {
    /// Removes the folder with everything inside. Whoever still uses it does so in vain.
    pub fn remove(&self) {
        remove(&self.folder);
    }
}

impl Drop for RunDir {
    fn drop(&mut self) {
        self.remove();
    }
}

impl InstanceDir {
    /// The folder itself.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.folder
    }
}

impl Drop for InstanceDir {
    fn drop(&mut self) {
        // A project may hold many files, and this may run on a thread that serves others.
        let folder = std::mem::take(&mut self.folder);
        let spare = folder.clone();
        if std::thread::Builder::new().spawn(move || remove_patiently(&folder)).is_err() {
            remove(&spare);
        }
    }
}

/// Waits until no other server looks for dead runs or makes its own folder: one whose lock is not yet held would count
/// as dead. The turn ends with what is given back.
fn take_turn(runs: &Path) -> io::Result<File> {
    let turn = File::open(runs)?;
    let deadline = Instant::now() + TURN;
    loop {
        match turn.try_lock() {
            Ok(()) => return Ok(turn),
            Err(TryLockError::WouldBlock) if Instant::now() < deadline => std::thread::sleep(LOOK),
            Err(TryLockError::WouldBlock) => {
                return Err(io::Error::new(io::ErrorKind::TimedOut, "another program keeps its folder 'runs' locked"));
            }
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
}

/// The folders of runs whose server has ended, with their locks: who holds them sweeps, nobody else.
fn dead(runs: &Path) -> Vec<(PathBuf, Option<File>)> {
    let entries = std::fs::read_dir(runs).into_iter().flatten().flatten();
    let claim = |folder: PathBuf| match File::open(folder.join(LOCK)) {
        Ok(lock) => lock.try_lock().is_ok().then_some((folder, Some(lock))),
        // It is being removed, or its server died while it made it.
        Err(_) => is_old(&folder).then_some((folder, None)),
    };
    entries.filter_map(|entry| claim(entry.path())).collect()
}

fn is_old(folder: &Path) -> bool {
    let modified = folder.metadata().and_then(|about| about.modified());
    modified.is_ok_and(|time| time.elapsed().is_ok_and(|age| age >= Duration::from_secs(10)))
}

/// Removes the folders of dead runs, and ends processes that carry their mark.
fn sweep(dead: &[(PathBuf, Option<File>)]) -> Swept {
    let mut swept = Swept { runs: dead.len(), processes: 0 };
    for (folder, _) in dead {
        process_tree::await_guardians(folder);
        swept.processes += process_tree::kill_marked(folder);
        remove(folder);
    }
    swept
}

/// Removes a folder, as far as that can be done at once.
pub fn remove(folder: &Path) {
    // A process that is just ending may still write: what it adds is removed by the second try.
    if try_to_remove(folder).is_err()
        && let Err(error) = try_to_remove(folder)
    {
        log::error!("{} can't be removed: {error}", folder.display());
    }
}

/// Removes a folder, and tries again for a while where it can't. Waits: only for threads of their own.
pub fn remove_patiently(folder: &Path) {
    for pause in PAUSES {
        match try_to_remove(folder) {
            Ok(()) => return,
            Err(error) => log::warn!("{} can't be removed yet: {error}", folder.display()),
        }
        std::thread::sleep(pause);
    }
    remove(folder);
}

fn try_to_remove(folder: &Path) -> io::Result<()> {
    let removed = match std::fs::remove_dir_all(folder) {
        // A simulation may have taken the right to write from its own folders.
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => {
            open_up(folder);
            std::fs::remove_dir_all(folder)
        }
        other => other,
    };
    match removed {
        Err(error) if error.kind() == io::ErrorKind::NotFound && !folder.exists() => Ok(()),
        other => other,
    }
}

/// Lets this user change all folders below one. Links are not followed.
fn open_up(folder: &Path) {
    let mut open = vec![folder.to_owned()];
    while let Some(folder) = open.pop() {
        std::fs::set_permissions(&folder, Permissions::from_mode(0o700)).ok();
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        open.extend(entries.filter(|one| one.file_type().is_ok_and(|kind| kind.is_dir())).map(|one| one.path()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dead_run_is_swept_and_a_living_one_is_not() {
        let cache = tempfile::tempdir().unwrap();
        let (first, _) = RunDir::open(cache.path()).unwrap();
        let dead = cache.path().canonicalize().unwrap().join("runs/run-dead");
        std::fs::create_dir_all(dead.join("instance-x")).unwrap();
        std::fs::write(dead.join(LOCK), "").unwrap();
        let mut orphan = std::process::Command::new("sleep");
        let mut orphan = orphan.arg("100").env(process_tree::MARK, dead.join("instance-x")).spawn().unwrap();
        let (_second, swept) = RunDir::open(cache.path()).unwrap();
        assert_eq!(swept, Swept { runs: 1, processes: 1 });
        assert!(!orphan.wait().unwrap().success());
        assert!(first.path().exists() && !dead.exists());
    }

    #[test]
    fn what_can_not_be_removed_at_once_is_removed_later() {
        let cache = tempfile::tempdir().unwrap();
        let (run, _) = RunDir::open(cache.path()).unwrap();
        let instance = run.instance().unwrap();
        let folder = instance.path().to_owned();
        let locked = folder.join("locked");
        std::fs::create_dir_all(locked.join("inside")).unwrap();
        std::fs::set_permissions(&locked, Permissions::from_mode(0o500)).unwrap();
        // Somebody who makes files faster than they can be removed, for a while.
        let busy = folder.join("busy");
        let writer = std::thread::spawn(move || {
            let end = std::time::Instant::now() + Duration::from_millis(150);
            for number in 0.. {
                std::fs::create_dir_all(busy.join(format!("{number}"))).ok();
                if std::time::Instant::now() > end {
                    return;
                }
            }
        });
        std::thread::sleep(Duration::from_millis(20));
        drop(instance);
        writer.join().unwrap();
        let end = std::time::Instant::now() + Duration::from_secs(20);
        while folder.exists() {
            assert!(std::time::Instant::now() < end, "it is still there");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    #[test]
    fn dropping_removes() {
        let cache = tempfile::tempdir().unwrap();
        let (run, _) = RunDir::open(cache.path()).unwrap();
        let instance = run.instance().unwrap();
        std::fs::write(instance.path().join("file"), "x").unwrap();
        let folder = run.path().to_owned();
        drop((instance, run));
        assert!(!folder.exists());
    }
}
