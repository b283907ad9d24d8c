//! Cached bare repositories on disk, under a size budget. Safe for several servers that share the folder.
//!
//! `CACHE/git/NAME` is a bare repository, `NAME.use` is locked (shared) by everybody who reads it, `NAME.fetch` is
//! locked by whoever adds to it. The time of the `.use` file says when a repository was used last.

use std::fs::{File, TryLockError};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// The folder of cached repositories.
#[derive(Debug, Clone)]
pub struct RepositoryCache {
    folder: PathBuf,
    budget: u64,
}

/// A cached repository that is in use: as long as this lives it is not removed.
#[derive(Debug)]
pub struct InUse {
    path: PathBuf,
    fetch_lock: PathBuf,
    #[expect(dead_code, reason = "it is held, not read")]
    lock: File,
}

/// The right to add to a cached repository.
#[derive(Debug)]
pub struct Fetching {
    _lock: File,
}

/// Between two looks at a lock that somebody else holds.
const PATIENCE: Duration = Duration::from_millis(20);

impl RepositoryCache {
    /// Opens the cache below `folder`, which may take `budget` bytes.
    ///
    /// # Errors
    /// When the folder can't be made.
    pub fn open(folder: &Path, budget: u64) -> io::Result<Self> {
        let folder = folder.join("git");
        std::fs::create_dir_all(&folder)?;
        Ok(Self { folder: folder.canonicalize()?, budget })
    }

    /// Takes a repository into use. It may not exist yet: then its path is where it belongs.
    ///
    /// # Errors
    /// When its lock can't be opened.
    pub async fn take(&self, location: &str) -> io::Result<InUse> {
        let name = file_name(location);
        let lock = File::options().create(true).append(true).open(self.folder.join(format!("{name}.use")))?;
        wait(|| lock.try_lock_shared()).await?;
        lock.set_modified(SystemTime::now())?;
        let fetch_lock = self.folder.join(format!("{name}.fetch"));
        Ok(InUse { path: self.folder.join(&name), fetch_lock, lock })
    }

    /// Removes the repositories that were not used for longest, until all fit into the budget. Those in use stay.
    ///
    /// Gives back how many were removed. Reads the whole folder: not for a thread that serves others.
    #[must_use]
    pub fn shrink(&self) -> usize {
        let Ok(entries) = std::fs::read_dir(&self.folder) else {
            return 0;
        };
        let locks = entries.flatten().map(|entry| entry.path());
        let locks = locks.filter(|path| path.extension().is_some_and(|extension| extension == "use"));
        let mut repositories: Vec<(SystemTime, u64, PathBuf)> = locks
            .filter_map(|lock| {
                let used = lock.metadata().and_then(|about| about.modified()).ok()?;
                Some((used, size_of(&lock.with_extension("")), lock))
            })
            .collect();
        repositories.sort();
        let mut total: u64 = repositories.iter().map(|(_, size, _)| size).sum();
        let mut removed = 0;
        for (_, size, lock) in repositories {
            if total <= self.budget {
                break;
            }
            if size > 0 && remove_unused(&lock) {
                log::info!("removed {} from the cache", lock.with_extension("").display());
                total -= size;
                removed += 1;
            }
        }
        removed
    }
}

impl InUse {
    /// Where the bare repository is, or belongs.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Waits for the right to add to the repository, and removes what a broken fetch has left.
    ///
    /// # Errors
    /// When its lock can't be opened.
    pub async fn fetching(&self) -> io::Result<Fetching> {
        let lock = File::options().create(true).append(true).open(&self.fetch_lock)?;
        wait(|| lock.try_lock()).await?;
        for broken in self.incoming().chain(self.locks()) {
            std::fs::remove_file(broken).ok();
        }
        Ok(Fetching { _lock: lock })
    }

    /// How many bytes a fetch that is under way has received.
    #[must_use]
    pub fn received(&self) -> u64 {
        self.incoming().filter_map(|path| path.metadata().ok()).map(|about| about.len()).sum()
    }

    /// Packs that are being received, or were when git was ended.
    fn incoming(&self) -> impl Iterator<Item = PathBuf> {
        let entries = std::fs::read_dir(self.path.join("objects/pack")).into_iter().flatten().flatten();
        entries.filter(|entry| entry.file_name().as_encoded_bytes().starts_with(b"tmp_")).map(|entry| entry.path())
    }

    /// Locks that git leaves behind when it is killed: each would make every later fetch fail.
    fn locks(&self) -> impl Iterator<Item = PathBuf> {
        let folders = [self.path.clone(), self.path.join("refs/fleet")];
        let entries = folders.into_iter().flat_map(|folder| std::fs::read_dir(folder).into_iter().flatten().flatten());
        entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|extension| extension == "lock"))
    }

    /// Whether the bare repository is there.
    #[must_use]
    pub fn is_made(&self) -> bool {
        self.path.join("HEAD").is_file()
    }

    /// Whether a commit was fetched, with all that belongs to it.
    #[must_use]
    pub fn has(&self, reference: &str) -> bool {
        self.path.join(reference).is_file()
    }
}

/// Removes a repository unless somebody uses it.
fn remove_unused(lock: &Path) -> bool {
    let Ok(held) = File::options().append(true).open(lock) else {
        return false;
    };
    // The locks' files stay: one that was removed could still be locked by another who has it open.
    held.try_lock().is_ok() && std::fs::remove_dir_all(lock.with_extension("")).is_ok()
}

async fn wait(mut attempt: impl FnMut() -> Result<(), TryLockError>) -> io::Result<()> {
    loop {
        match attempt() {
            Ok(()) => return Ok(()),
            Err(TryLockError::WouldBlock) => actix_rt::time::sleep(PATIENCE).await,
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
}

/// A readable name, made unique by a hash.
fn file_name(location: &str) -> String {
    let mut hasher = DefaultHasher::new();
    location.hash(&mut hasher);
    let readable = location.chars().map(|letter| if letter.is_ascii_alphanumeric() { letter } else { '-' });
    let readable: String = readable.skip_while(|letter| *letter == '-').take(100).collect();
    format!("{readable}-{:016x}", hasher.finish())
}

/// The bytes of all files below a folder.
fn size_of(folder: &Path) -> u64 {
    let mut total = 0;
    let mut open = vec![folder.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            match entry.metadata() {
                Ok(about) if about.is_dir() => open.push(entry.path()),
                Ok(about) => total += about.len(),
                Err(_) => {}
            }
        }
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    fn age_of(cache: &RepositoryCache, name: &str, seconds: u64) {
        let lock = cache.folder.join(format!("{}.use", file_name(name)));
        let file = File::options().append(true).open(lock).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(seconds)).unwrap();
    }

    #[actix_rt::test]
    async fn the_least_recently_used_goes_first_and_one_in_use_stays() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 250).unwrap();
        for (age, name) in [(30, "in use"), (20, "old"), (10, "new")] {
            let taken = cache.take(name).await.unwrap();
            std::fs::create_dir(taken.path()).unwrap();
            std::fs::write(taken.path().join("pack"), [0; 100]).unwrap();
            age_of(&cache, name, age);
        }
        let _used = cache.take("in use").await.unwrap();
        age_of(&cache, "in use", 30);
        assert_eq!(cache.shrink(), 1);
        let exists = |name| cache.folder.join(file_name(name)).exists();
        assert!(exists("in use") && !exists("old") && exists("new"));
    }

    #[actix_rt::test]
    async fn only_one_fetches_at_a_time_and_finds_no_rest_of_another() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1).unwrap();
        let one = cache.take("x").await.unwrap();
        let other = cache.take("x").await.unwrap();
        let packs = one.path().join("objects/pack");
        std::fs::create_dir_all(&packs).unwrap();
        let fetching = one.fetching().await.unwrap();
        std::fs::write(packs.join("tmp_pack_x"), [0; 10]).unwrap();
        assert_eq!(other.received(), 10);
        let soon = Duration::from_millis(60);
        assert!(actix_rt::time::timeout(soon, other.fetching()).await.is_err());
        drop(fetching);
        let _fetching = other.fetching().await.unwrap();
        assert_eq!(other.received(), 0);
    }

    #[test]
    fn names_are_short_readable_and_unique() {
        let name = file_name("https://github.com/lab/arm.git");
        assert!(name.starts_with("https---github-com-lab-arm-git-"), "{name}");
        assert_ne!(file_name(&format!("{}a", "x".repeat(300))), file_name(&format!("{}b", "x".repeat(300))));
        assert!(file_name(&"x".repeat(2000)).len() < 200);
    }
}
