//! The directory `cacheDir` and the cached repositories in it: `git/NAME` is bare, and its mtime is its last use.
//!
//! Above `cacheSize`, repositories not in use are evicted, least recently used first.

use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak, mpsc};
use std::time::{Duration, Instant, SystemTime};

use sha2::{Digest, Sha256};
use tokio::sync::Mutex;

use super::disk::{spawn_blocking_io, sum};
use super::git::Git;
use super::repository::Repository;
use crate::shared::run::permanent;
use crate::simulation::config::Remote;
use crate::simulation::process::{disk_usage, has_several_runs, remove_tree};

/// The directory `cacheDir`, which only one server may use.
pub struct CacheDir {
    /// Its canonical path.
    pub folder: PathBuf,
    /// Locks it until this is closed, here and where it was passed to.
    pub lock: File,
}

/// The cached repositories of a server.
pub struct RepositoryCache {
    folder: PathBuf,
    git: Arc<Git>,
    /// The repositories in use.
    in_use: Mutex<HashMap<PathBuf, Weak<Repository>>>,
    /// Signals that a repository has grown, and is no longer in use.
    growth: mpsc::Sender<()>,
}

/// The file that is locked.
const LOCK: &str = "lock";
/// Contents of a repository: single commits.
pub const COMMITS: &str = "";
/// Contents of a repository: the commits of all branches and tags, without files if the remote supports that.
pub const HISTORY: &str = " history";
/// Time for which a killed server may still hold the lock: a child forked just before keeps the descriptor until
/// `execve`.
const LOCK_WAIT: Duration = Duration::from_secs(1);
/// Interval between two attempts to lock.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

impl CacheDir {
    /// Creates the directory if necessary, and locks it, unless the process before has passed its lock (`passed`). Blocks
    /// for up to a second, which is acceptable during start.
    ///
    /// # Errors
    /// When the directory can't be created, or another server uses it, or the lock is that of another directory.
    pub fn claim(folder: &Path, passed: Option<File>) -> io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        let folder = folder.canonicalize()?;
        if let Some(lock) = passed {
            let here = std::fs::metadata(folder.join(LOCK))?;
            let of_lock = lock.metadata()?;
            return if (here.dev(), here.ino()) == (of_lock.dev(), of_lock.ino()) {
                Ok(Self { folder, lock })
            } else {
                Err(io::Error::other("it has changed, which needs a stop and a start"))
            };
        }
        let lock = File::options()
            .write(true)
            .create(true)
            .truncate(false)
            .open(folder.join(LOCK))?;
        let deadline = Instant::now() + LOCK_WAIT;
        while let Err(error) = lock.try_lock() {
            if Instant::now() > deadline {
                let why = "another simulation server uses it, and each needs one of its own";
                return Err(io::Error::other(format!("{why}: {error}")));
            }
            std::thread::sleep(RETRY_INTERVAL);
        }
        Ok(Self { folder, lock })
    }
}

impl RepositoryCache {
    /// Opens the cache in `cacheDir`, and starts the thread that keeps it within its budget.
    ///
    /// # Errors
    /// When its directory can't be created, or there is no thread.
    pub fn open(cache: &Path, git: Arc<Git>) -> io::Result<Arc<Self>> {
        let folder = cache.join("git");
        std::fs::create_dir_all(&folder)?;
        let (growth, grown) = mpsc::channel();
        let cache = Arc::new(Self {
            folder,
            git,
            in_use: Mutex::default(),
            growth,
        });
        let kept = Arc::downgrade(&cache);
        permanent::thread("cache", move || keep_within_budget(&kept, &grown))?;
        Ok(cache)
    }

    /// The repository with this content of `remote`. It is in use until the returned value is dropped.
    ///
    /// # Errors
    /// When the cache's directory can't be created.
    pub async fn repository(&self, remote: &Remote, content: &str) -> io::Result<Arc<Repository>> {
        let path = self.folder.join(folder_name(&(remote.key() + content)));
        let repository = {
            let mut in_use = self.in_use.lock().await;
            in_use.retain(|_, repository| repository.strong_count() > 0);
            let known = in_use.get(&path).and_then(Weak::upgrade);
            let repository = known.unwrap_or_else(|| {
                let git = Arc::clone(&self.git);
                let growth = self.growth.clone();
                Arc::new(Repository::new(path.clone(), remote.clone(), git, growth))
            });
            in_use.insert(path.clone(), Arc::downgrade(&repository));
            repository
        };
        repository.remote.lock().clone_from(remote);
        let folder = self.folder.clone();
        spawn_blocking_io(move || {
            std::fs::create_dir_all(folder)?;
            // It may not exist yet.
            File::open(&path)
                .and_then(|folder| folder.set_modified(SystemTime::now()))
                .ok();
            Ok(())
        })
        .await?;
        Ok(repository)
    }

    /// Evicts unused repositories until the others fit into the budget. Blocks.
    fn shrink(&self) {
        if self.folder.parent().is_some_and(has_several_runs) {
            return;
        }
        let mut all: Vec<(SystemTime, u64, PathBuf)> = Vec::new();
        for entry in std::fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            if let Ok(used) = entry.metadata().and_then(|about| about.modified()) {
                all.push((used, sum(&entry.path(), disk_usage::length), entry.path()));
            }
        }
        all.sort();
        let mut total: u64 = all.iter().map(|(_, size, _)| size).sum();
        let budget = self.git.config.cache_size << 20;
        for (_, size, path) in all {
            if total <= budget {
                return;
            }
            // If the server is killed meanwhile, the rest is later evicted like a repository.
            let removed = path.with_extension(rand::random::<u64>().to_string());
            {
                // New users wait for the lock, and then create the repository again.
                let in_use = self.in_use.blocking_lock();
                if in_use
                    .get(&path)
                    .is_some_and(|repository| repository.strong_count() > 0)
                    || std::fs::rename(&path, &removed).is_err()
                {
                    continue;
                }
            }
            match remove_tree(&removed) {
                Ok(()) => {
                    log::info!("removed {} from the cache", path.display());
                    total -= size;
                }
                Err(error) => log::warn!("{} can't be removed: {error}", path.display()),
            }
        }
    }
}

/// Keeps a cache within its budget until it is dropped. Repositories in use keep the channel open, too.
fn keep_within_budget(cache: &Weak<RepositoryCache>, growth: &mpsc::Receiver<()>) {
    while let Some(kept) = cache.upgrade() {
        kept.shrink();
        drop(kept);
        if growth.recv().is_err() {
            return;
        }
        // One look is enough for all that have grown meanwhile.
        while growth.try_recv().is_ok() {}
    }
}

/// A readable name, made unique by a hash: `https---github-com-lab-arm-git-0123456789abcdef`.
fn folder_name(key: &str) -> String {
    let readable = key
        .chars()
        .map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '-' });
    let readable: String = readable.skip_while(|letter| *letter == '-').take(100).collect();
    let hash = hex::encode(Sha256::digest(key));
    format!("{readable}-{hash:.16}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_short_readable_unique_and_always_the_same() {
        assert_eq!(
            folder_name("https://github.com/lab/arm.git"),
            "https---github-com-lab-arm-git-a74f228b568c06bb"
        );
        assert_ne!(
            folder_name(&format!("{}a", "x".repeat(300))),
            folder_name(&format!("{}b", "x".repeat(300)))
        );
        assert!(folder_name(&"x".repeat(2000)).len() < 200);
    }
}
