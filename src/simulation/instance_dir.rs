//! The folders of running simulations: guards whose drop removes them, and records by which a later run of the server
//! finds what an earlier one left.

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

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
        let swept = sweep(&runs);
        let folder = tempfile::Builder::new().prefix("run-").tempdir_in(&runs)?.keep();
        let lock = File::create(folder.join(LOCK))?;
        lock.lock()?;
        Ok((Self { folder, _lock: lock }, swept))
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
        if std::thread::Builder::new().spawn(move || remove(&folder)).is_err() {
            remove(&spare);
        }
    }
}

/// Removes the folders of runs whose lock nobody holds, and ends processes that carry their mark.
fn sweep(runs: &Path) -> Swept {
    let mut swept = Swept::default();
    let Ok(entries) = std::fs::read_dir(runs) else {
        return swept;
    };
    for folder in entries.flatten().map(|entry| entry.path()) {
        if is_alive(&folder) {
            continue;
        }
        swept.runs += 1;
        swept.processes += process_tree::kill_marked(&folder);
        remove(&folder);
    }
    swept
}

/// Whether the server of a run still lives. One that is just making its folder has no lock yet, and counts as alive
/// while the folder is young.
fn is_alive(folder: &Path) -> bool {
    match File::open(folder.join(LOCK)) {
        Ok(lock) => matches!(lock.try_lock(), Err(TryLockError::WouldBlock)),
        Err(_) => folder
            .metadata()
            .and_then(|about| about.modified())
            .is_ok_and(|time| time.elapsed().is_ok_and(|age| age < std::time::Duration::from_secs(10))),
    }
}

fn remove(folder: &Path) {
    // A process that is just ending may still write: what it adds is removed by the second try.
    let gone = |result: io::Result<()>| match result {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Some(error),
        _ => None,
    };
    if gone(std::fs::remove_dir_all(folder)).is_some()
        && let Some(error) = gone(std::fs::remove_dir_all(folder))
    {
        log::error!("{} can't be removed: {error}", folder.display());
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
