//! The directories of running simulations: guards that remove them on drop.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::process_tree;
use super::remove_tree::remove_tree;

/// The directory of one run of the server: `runs/run-*` in `cacheDir`. It contains a directory for each simulation.
pub struct RunDir {
    folder: PathBuf,
}

/// The directory of one simulation. Dropping it removes it with its contents.
#[derive(Debug)]
pub struct InstanceDir {
    folder: PathBuf,
}

/// Attempts to remove a directory before that is left to the next start, and the pause between two attempts.
const TRIES: u32 = 60;
const PAUSE: Duration = Duration::from_secs(1);

impl RunDir {
    /// Creates the directory of this run below `cache`, and removes what earlier runs have left there. Only for the
    /// server that owns `cache`: the processes of every other run are killed.
    ///
    /// # Errors
    /// When the directory can't be created.
    pub fn open(cache: &Path) -> io::Result<Self> {
        let runs = cache.join("runs");
        std::fs::create_dir_all(&runs)?;
        // Marks of processes are compared with this path, so it must be canonical.
        let runs = runs.canonicalize()?;
        let (mut dead, mut processes) = (0, 0);
        for run in std::fs::read_dir(&runs)?.flatten() {
            dead += 1;
            processes += process_tree::kill_marked(&run.path());
            remove(&run.path());
        }
        if dead > 0 {
            log::warn!("removed what {dead} earlier runs had left, {processes} processes among it");
        }
        let folder = tempfile::Builder::new().prefix("run-").tempdir_in(&runs)?.keep();
        Ok(Self { folder })
    }

    /// Creates a directory for a simulation, with the directory of its project inside.
    ///
    /// # Errors
    /// When a directory can't be created.
    pub fn instance(&self) -> io::Result<InstanceDir> {
        // The directory of the run may have been removed.
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

    /// Removes the directory with its contents.
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

    /// The directory of the project. It is created with the instance: if it were created later, that could happen after
    /// the instance was removed.
    pub fn project(&self) -> PathBuf {
        self.folder.join("project")
    }
}

impl Drop for InstanceDir {
    fn drop(&mut self) {
        // A project may contain many files, and this may run on an actor's thread.
        let folder = std::mem::take(&mut self.folder);
        let shown = folder.display().to_string();
        if let Err(error) = std::thread::Builder::new().spawn(move || remove_patiently(&folder)) {
            log::error!("{shown} is left to the next start: no thread for its removal: {error}");
        }
    }
}

/// Removes a directory, and retries each second for a minute: a machine without free files or processes for `rm` may
/// recover. Blocks: only for threads of their own.
fn remove_patiently(folder: &Path) {
    for _ in 0..TRIES {
        if remove_tree(folder).is_ok() {
            return;
        }
        std::thread::sleep(PAUSE);
    }
    remove(folder);
}

/// Removes a directory. What can't be removed is logged, and left to the next start. Blocks.
pub fn remove(folder: &Path) {
    if let Err(error) = remove_tree(folder) {
        log::error!("{} can't be removed: {error}", folder.display());
    }
}
