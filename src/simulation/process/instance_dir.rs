//! The folders of running simulations: guards that remove them when they are dropped.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::process_tree;
use super::remove_tree::remove_tree;

/// The folder of one run of the server: `runs/run-*` in the cache folder. It holds a folder for each simulation.
#[derive(Debug)]
pub struct RunDir {
    folder: PathBuf,
}

/// The folder of one simulation. Dropping it removes it with everything inside.
#[derive(Debug)]
pub struct InstanceDir {
    folder: PathBuf,
}

/// What earlier runs had left.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Leftovers {
    /// Runs that had ended without removing their folder.
    pub runs: usize,
    /// Processes of theirs that were still alive.
    pub processes: usize,
}

/// How often it is tried to remove a folder before that is left to the next start, and the pause between two tries.
const TRIES: u32 = 60;
const PAUSE: Duration = Duration::from_secs(1);

impl RunDir {
    /// Makes the folder of this run below `cache`, and removes what earlier runs have left there. Only for the server
    /// that owns the cache folder: the processes of every other run are killed.
    ///
    /// # Errors
    /// When the folder can't be made.
    pub fn open(cache: &Path) -> io::Result<(Self, Leftovers)> {
        let runs = cache.join("runs");
        std::fs::create_dir_all(&runs)?;
        // Marks of processes are compared with this path: it must be the one without links.
        let runs = runs.canonicalize()?;
        let mut leftovers = Leftovers::default();
        for dead in std::fs::read_dir(&runs)?.flatten() {
            leftovers.runs += 1;
            leftovers.processes += process_tree::kill_marked(&dead.path());
            remove(&dead.path());
        }
        let folder = tempfile::Builder::new().prefix("run-").tempdir_in(&runs)?.keep();
        Ok((Self { folder }, leftovers))
    }

    /// Makes a folder for a simulation, with the folder of its project inside.
    ///
    /// # Errors
    /// When a folder can't be made.
    pub fn instance(&self) -> io::Result<InstanceDir> {
        // Somebody may have removed the folder of the run.
        std::fs::create_dir_all(&self.folder)?;
        let folder = tempfile::Builder::new().prefix("instance-").tempdir_in(&self.folder)?.keep();
        let instance = InstanceDir { folder };
        std::fs::create_dir(instance.project())?;
        Ok(instance)
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.folder
    }

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
    pub fn path(&self) -> &Path {
        &self.folder
    }

    /// The folder of the project. It is there as long as the instance is: whoever made it later could make it again after
    /// the instance was removed.
    pub fn project(&self) -> PathBuf {
        self.folder.join("project")
    }
}

impl Drop for InstanceDir {
    fn drop(&mut self) {
        // A project may hold many files, and this may run on a thread that serves others.
        let folder = std::mem::take(&mut self.folder);
        let shown = folder.display().to_string();
        if let Err(error) = std::thread::Builder::new().spawn(move || remove_patiently(&folder)) {
            log::error!("{shown} is left to the next start: no thread for its removal: {error}");
        }
    }
}

/// Removes a folder, and tries again each second for a minute: a machine that has no file or process left for `rm` has
/// them again. Blocks: only for threads of their own.
fn remove_patiently(folder: &Path) {
    for _ in 0..TRIES {
        if remove_tree(folder).is_ok() {
            return;
        }
        std::thread::sleep(PAUSE);
    }
    remove(folder);
}

/// Removes a folder. What can't be removed is logged, and left to the next start. Blocks.
pub fn remove(folder: &Path) {
    if let Err(error) = remove_tree(folder) {
        log::error!("{} can't be removed: {error}", folder.display());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_earlier_run_is_removed_with_its_processes() {
        let cache = tempfile::tempdir().unwrap();
        let dead = cache.path().canonicalize().unwrap().join("runs/run-dead");
        std::fs::create_dir_all(dead.join("instance-x")).unwrap();
        let mut orphan = std::process::Command::new("sleep");
        let mut orphan = orphan.arg("100").env(process_tree::MARK, dead.join("instance-x")).spawn().unwrap();
        let (run, leftovers) = RunDir::open(cache.path()).unwrap();
        assert_eq!(leftovers, Leftovers { runs: 1, processes: 1 });
        assert!(!orphan.wait().unwrap().success());
        assert!(run.path().exists() && !dead.exists());
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
