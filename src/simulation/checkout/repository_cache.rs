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
use super::disk::{blocking, sum};
use super::git::Git;
use super::repository::Repository;
use crate::simulation::config::{Remote, SimulationConfig};
use crate::simulation::process::{disk_usage, remove_tree};

/// The cached repositories of a server.
pub struct RepositoryCache {
    folder: PathBuf,
    git: Arc<Git>,
    config: Arc<SimulationConfig>,
    /// The repositories in use.
    in_use: Mutex<HashMap<PathBuf, Weak<Repository>>>,
    /// Signals that a repository has grown.
    growth: Arc<Notify>,
    _dir: CacheDir,
}

/// Contents of a repository: single commits.
pub const COMMITS: &str = "";
/// Contents of a repository: the commits of all branches and tags, without files if the remote supports that.
pub const HISTORY: &str = " history";
/// The extension of a directory that is being removed. Names of repositories have no dots.
const REMOVED: &str = "removed";
/// Interval between two attempts to bring the cache within its budget: repositories in use stay.
const RETRY_INTERVAL: Duration = Duration::from_secs(2);

impl RepositoryCache {
    /// Opens the cache in `dir`.
    ///
    /// # Errors
    /// When its directory can't be created.
    pub fn open(dir: CacheDir, git: Arc<Git>, config: Arc<SimulationConfig>) -> io::Result<Self> {
        let folder = dir.folder.join("git");
        std::fs::create_dir_all(&folder)?;
        Ok(Self { folder, git, config, in_use: Mutex::default(), growth: Arc::default(), _dir: dir })
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
            if let Some(repository) = &known {
                repository.set_remote(remote);
            }
            known.unwrap_or_else(|| {
                let (git, config, growth) = (Arc::clone(&self.git), Arc::clone(&self.config), Arc::clone(&self.growth));
                let repository = Arc::new(Repository::new(path.clone(), remote.clone(), git, config, growth));
                in_use.insert(path.clone(), Arc::downgrade(&repository));
                repository
            })
        };
        let folder = self.folder.clone();
        blocking(move || {
            std::fs::create_dir_all(folder)?;
            // It may not be there yet.
            File::open(&path).and_then(|folder| folder.set_modified(SystemTime::now())).ok();
            Ok(())
        })
        .await?;
        Ok(repository)
    }

    /// Keeps the cache within its budget. Never returns.
    pub async fn keep_within_budget(self: Arc<Self>) {
        loop {
            let this = Arc::clone(&self);
            let shrunk = actix_rt::task::spawn_blocking(move || this.shrink()).await;
            match shrunk {
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
                all.push((used, sum(&path, disk_usage::length), path));
            }
        }
        all.sort();
        let mut total: u64 = all.iter().map(|(_, size, _)| size).sum();
        let budget = self.config.cache_size << 20;
        for (_, size, path) in all {
            if total > budget && self.remove_unused(&path) {
                log::info!("removed {} from the cache", path.display());
                total -= size;
            }
        }
        total <= budget
    }

    /// Removes a repository unless it is in use. Blocks.
    fn remove_unused(&self, path: &Path) -> bool {
        let removed = path.with_extension(REMOVED);
        {
            // The lock makes new users wait; they then recreate the repository.
            let in_use = self.in_use.blocking_lock();
            if in_use.get(path).is_some_and(|repository| repository.strong_count() > 0)
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
