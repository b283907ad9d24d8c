//! The cached repositories: `CACHEDIR/git/NAME` is a bare repository, and its mtime is the last use.
//!
//! Above `cacheSize`, repositories not in use are evicted, least recently used first.

use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};
use std::time::{Duration, SystemTime};

use sha2::{Digest, Sha256};
use tokio::sync::{Mutex, Notify};

use super::cache_dir::CacheDir;
use super::checkout_limits::CheckoutLimits;
use super::disk::size_of;
use super::git::Git;
use super::mirrors::Remote;
use super::repository::Repository;
use crate::simulation::process::remove_tree;

/// The cached repositories of a server.
pub struct RepositoryCache {
    folder: PathBuf,
    /// Size limit of all repositories, in bytes.
    budget: u64,
    git: Arc<Git>,
    limits: CheckoutLimits,
    /// The repositories in use.
    in_use: Mutex<HashMap<PathBuf, Weak<Repository>>>,
    /// Signals that a repository has grown.
    growth: Arc<Notify>,
    _dir: CacheDir,
}

/// The extension of a directory that is being removed. Names of repositories have no dots.
const REMOVED: &str = "removed";
/// Interval between two attempts to bring the cache within its budget: repositories in use stay.
const RETRY_INTERVAL: Duration = Duration::from_secs(2);

impl RepositoryCache {
    /// Opens the cache in `dir`, with a limit of `budget` bytes.
    ///
    /// # Errors
    /// When its directory can't be created.
    pub fn open(dir: CacheDir, budget: u64, git: Arc<Git>, limits: CheckoutLimits) -> io::Result<Self> {
        let folder = dir.path().join("git");
        std::fs::create_dir_all(&folder)?;
        Ok(Self { folder, budget, git, limits, in_use: Mutex::default(), growth: Arc::default(), _dir: dir })
    }

    /// The repository with commits of `remote`. It is in use until the returned value is dropped.
    ///
    /// # Errors
    /// When the cache's directory can't be created.
    pub async fn commits(&self, remote: &Remote) -> io::Result<Arc<Repository>> {
        self.repository(&remote.key(), remote).await
    }

    /// The repository with the history of `remote`: the commits of all branches and tags, without files if the remote
    /// supports that.
    ///
    /// # Errors
    /// When the cache's directory can't be created.
    pub async fn history(&self, remote: &Remote) -> io::Result<Arc<Repository>> {
        self.repository(&format!("{} history", remote.key()), remote).await
    }

    async fn repository(&self, key: &str, remote: &Remote) -> io::Result<Arc<Repository>> {
        let path = self.folder.join(folder_name(key));
        let repository = {
            let mut in_use = self.in_use.lock().await;
            in_use.retain(|_, repository| repository.strong_count() > 0);
            let known = in_use.get(&path).and_then(Weak::upgrade);
            if let Some(repository) = &known {
                repository.set_remote(remote);
            }
            known.unwrap_or_else(|| {
                let (git, growth) = (Arc::clone(&self.git), Arc::clone(&self.growth));
                let repository = Arc::new(Repository::new(path.clone(), remote.clone(), git, self.limits, growth));
                in_use.insert(path.clone(), Arc::downgrade(&repository));
                repository
            })
        };
        let folder = self.folder.clone();
        actix_rt::task::spawn_blocking(move || {
            std::fs::create_dir_all(folder)?;
            match File::open(&path).and_then(|folder| folder.set_modified(SystemTime::now())) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
                _ => Ok(()),
            }
        })
        .await??;
        Ok(repository)
    }

    /// Signals that a repository has grown.
    pub fn grown(&self) {
        self.growth.notify_one();
    }

    /// Keeps the cache within its budget. Never returns.
    pub async fn keep_within_budget(self: Arc<Self>) {
        loop {
            let this = Arc::clone(&self);
            let shrunk = actix_rt::task::spawn_blocking(move || this.shrink()).await;
            match shrunk.inspect_err(|error| log::error!("the cache can't be kept within its budget: {error}")) {
                Ok(false) => actix_rt::time::sleep(RETRY_INTERVAL).await,
                _ => self.growth.notified().await,
            }
        }
    }

    /// Evicts unused repositories until the others fit into the budget. Returns whether they do. Blocks.
    fn shrink(&self) -> bool {
        let mut all: Vec<(SystemTime, u64, PathBuf)> = Vec::new();
        for entry in std::fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.extension().is_some_and(|extension| extension == REMOVED) {
                remove(&path);
            } else if let Ok(used) = entry.metadata().and_then(|about| about.modified()) {
                all.push((used, size_of(&path), path));
            }
        }
        all.sort();
        let mut total: u64 = all.iter().map(|(_, size, _)| size).sum();
        for (_, size, path) in all {
            if total > self.budget && self.remove_unused(&path) {
                log::info!("removed {} from the cache", path.display());
                total -= size;
            }
        }
        total <= self.budget
    }

    /// Removes a repository unless it is in use. Blocks.
    fn remove_unused(&self, path: &Path) -> bool {
        let removed = path.with_extension(REMOVED);
        {
            // The lock makes new users wait; they then recreate the repository.
            let in_use = self.in_use.blocking_lock();
            if in_use.get(&path.with_extension("")).is_some_and(|repository| repository.strong_count() > 0)
                || std::fs::rename(path, &removed).is_err()
            {
                return false;
            }
        }
        remove(&removed)
    }
}

/// Removes a directory; a failed removal is retried by the next pass. Returns whether it was removed.
fn remove(folder: &Path) -> bool {
    // A branch's name may have a thousand levels of directories.
    let removed = remove_tree(folder);
    if let Err(error) = &removed {
        log::warn!("{} can't be removed: {error}", folder.display());
    }
    removed.is_ok()
}

/// A readable name, made unique by a hash: `https---github-com-lab-arm-git-0123456789abcdef`.
fn folder_name(key: &str) -> String {
    let readable = key.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '-' });
    let readable: String = readable.skip_while(|letter| *letter == '-').take(100).collect();
    let hash = Sha256::digest(key).iter().take(8).fold(0, |hash: u64, byte| (hash << 8) | u64::from(*byte));
    format!("{readable}-{hash:016x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_short_readable_unique_and_always_the_same() {
        assert_eq!(folder_name("https://github.com/lab/arm.git"), "https---github-com-lab-arm-git-a74f228b568c06bb");
        assert_ne!(folder_name(&format!("{}a", "x".repeat(300))), folder_name(&format!("{}b", "x".repeat(300))));
        assert!(folder_name(&"x".repeat(2000)).len() < 200);
    }
}
