//! The directories of running simulations: guards that have them removed on drop, by the system's `rm`. It handles any
//! depth, which a recursion in the server would not, and does not follow symlinks. One thread removes them all: it is
//! there before the first of them, and needs no other thread on a machine that has none to spare.

use std::ffi::OsString;
use std::fs::{DirBuilder, File, TryLockError};
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::Duration;

use super::process_group::ExitReason;
use super::process_tree;
use super::runner::Run;
use crate::shared::run::permanent;
use crate::simulation::run_id::RunId;

/// The directory of one run of the server: `runs/run-*` in `cacheDir`. It contains a directory for each simulation. Its
/// process holds a lock on it (`flock`), which the kernel releases when that ends.
pub struct RunDir {
    path: PathBuf,
    _lock: File,
    /// The thread that removes the directories of simulations.
    remover: mpsc::Sender<PathBuf>,
}

/// The directory of one simulation. Dropping it removes it with its contents, soon afterwards.
#[derive(Debug)]
pub struct InstanceDir {
    path: PathBuf,
    remover: mpsc::Sender<PathBuf>,
}

/// Attempts to remove a directory before it is left to the next start, and the pause before another attempt: a machine
/// without free files or processes for `rm` may recover.
const TRIES: u32 = 60;
const PAUSE: Duration = Duration::from_secs(1);
/// Timeout of an attempt: a program that still runs may keep adding files.
const LIMIT: Duration = Duration::from_mins(10);

impl RunDir {
    /// Creates the directory of this run below `cache`, and removes what runs have left there whose process has ended.
    /// Returns also the runs that live. Only for the server that owns `cache`: the processes of dead runs are killed.
    ///
    /// # Errors
    /// When the directory can't be created, or there is no thread.
    pub fn open(cache: &Path) -> io::Result<(Self, Vec<RunId>)> {
        let runs = runs_in(cache);
        std::fs::create_dir_all(&runs)?;
        // Marks of processes are compared with this path, so it must be canonical.
        let runs = runs.canonicalize()?;
        let mut dead = 0;
        let mut living = Vec::new();
        for run in std::fs::read_dir(&runs)?.flatten() {
            let id = run.file_name().to_str().and_then(RunId::with_folder);
            if let Some(id) = id.filter(|_| is_alive(&run.path())) {
                living.push(id);
                continue;
            }
            dead += 1;
            process_tree::kill_marked(&run.path());
            remove(&run.path());
        }
        if dead > 0 {
            log::warn!("removed what {dead} earlier runs had left");
        }
        let (remover, folders) = mpsc::channel();
        permanent::thread("remover", move || remove_each(&folders))?;
        let path = runs.join(RunId::own().folder());
        DirBuilder::new().mode(0o700).create(&path)?;
        let lock = File::open(&path)?;
        lock.lock()?;
        let run = Self {
            path,
            _lock: lock,
            remover,
        };
        Ok((run, living))
    }

    /// Creates a directory for a simulation, with the directory of its project inside.
    ///
    /// # Errors
    /// When a directory can't be created.
    pub fn instance(&self) -> io::Result<InstanceDir> {
        // The directory of the run may have been removed.
        std::fs::create_dir_all(&self.path)?;
        let instance = InstanceDir {
            path: tempfile::Builder::new()
                .prefix("instance-")
                .tempdir_in(&self.path)?
                .keep(),
            remover: self.remover.clone(),
        };
        std::fs::create_dir(instance.project())?;
        Ok(instance)
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Removes the directory with its contents.
    pub fn remove(&self) {
        remove(&self.path);
    }
}

impl InstanceDir {
    /// The name of the project's directory in that of an instance.
    pub const PROJECT: &str = "project";

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The directory of the project. It is created with the instance: if it were created later, that could happen after
    /// the instance was removed.
    pub fn project(&self) -> PathBuf {
        self.path.join(Self::PROJECT)
    }
}

impl Drop for InstanceDir {
    fn drop(&mut self) {
        // A project may contain many files, and this may run on an actor's thread. The receiver lives as long as senders.
        self.remover.send(std::mem::take(&mut self.path)).ok();
    }
}

/// The directory with those of all runs.
pub fn runs_in(cache: &Path) -> PathBuf {
    cache.join("runs")
}

/// Whether the process of the run with this directory lives.
pub fn is_alive(run: &Path) -> bool {
    File::open(run).is_ok_and(|folder| matches!(folder.try_lock(), Err(TryLockError::WouldBlock)))
}

/// Whether more than one process of the server with this cache lives. Then none evicts anything from it: each knows only
/// what it uses itself.
pub fn has_several_runs(cache: &Path) -> bool {
    let runs = std::fs::read_dir(runs_in(cache)).into_iter().flatten().flatten();
    runs.filter(|run| is_alive(&run.path())).nth(1).is_some()
}

/// Removes each of these directories, until the last sender is gone.
fn remove_each(folders: &mpsc::Receiver<PathBuf>) {
    let mut left: Vec<(PathBuf, u32)> = Vec::new();
    loop {
        if left.is_empty() {
            let Ok(folder) = folders.recv() else { return };
            left.push((folder, TRIES));
        } else {
            std::thread::sleep(PAUSE);
        }
        left.extend(folders.try_iter().map(|folder| (folder, TRIES)));
        left.retain_mut(|(folder, tries)| {
            *tries -= 1;
            let Err(error) = remove_tree(folder) else { return false };
            if *tries == 0 {
                log::error!(
                    "{} is left to the next start, for it can't be removed: {error}",
                    folder.display()
                );
            }
            *tries > 0
        });
    }
}

/// Removes a directory. What can't be removed is logged, and left to the next start. Blocks.
pub fn remove(folder: &Path) {
    if let Err(error) = remove_tree(folder) {
        log::error!("{} can't be removed: {error}", folder.display());
    }
}

/// Removes a directory, if it is there. Blocks.
///
/// # Errors
/// When something in it can't be removed, or after ten minutes.
pub fn remove_tree(folder: &Path) -> io::Result<()> {
    run(&["rm", "-rf", "--"], folder).or_else(|_| {
        // A world's program may have removed the write permission of its directories.
        run(&["chmod", "-R", "u+rwX", "--"], folder).ok();
        run(&["rm", "-rf", "--"], folder)
    })
}

fn run(words: &[&str], folder: &Path) -> io::Result<()> {
    let command = words.iter().map(OsString::from).chain([folder.into()]);
    let mut complaint = String::new();
    // Its mark is not that of a run: ending a run does not kill it.
    let ran = Run::new(command, Path::new("/"), LIMIT).run_blocking(|line| complaint = line);
    let ran = ran.map_err(|error| io::Error::other(format!("{} {error}", words.join(" "))))?;
    if ran.ending == ExitReason::Code(0) {
        Ok(())
    } else {
        Err(io::Error::other(complaint))
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use nix::sys::stat::Mode;

    use super::*;

    #[test]
    fn links_are_removed_and_not_followed() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("folder");
        let other = place.path().join("other");
        std::fs::create_dir_all(folder.join("inside")).unwrap();
        std::fs::create_dir(&other).unwrap();
        std::fs::write(other.join("kept"), "").unwrap();
        std::os::unix::fs::symlink(&other, folder.join("link")).unwrap();
        std::os::unix::fs::symlink(&other, folder.join("inside/link")).unwrap();
        nix::unistd::mkfifo(&folder.join("inside/pipe"), Mode::S_IRWXU).unwrap();
        remove_tree(&folder).unwrap();
        assert!(!folder.exists() && other.join("kept").exists());
    }

    #[test]
    fn locked_folders_are_removed() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("folder");
        std::fs::create_dir_all(folder.join("a/b/c")).unwrap();
        for (locked, mode) in [("a/b/c", 0o000), ("a/b", 0o300), ("a", 0o500)] {
            std::fs::write(folder.join(locked).join("file"), "").unwrap();
            std::fs::set_permissions(folder.join(locked), std::fs::Permissions::from_mode(mode)).unwrap();
        }
        remove_tree(&folder).unwrap();
        assert!(!folder.exists());
    }
}
