//! Cached bare repositories on disk, under a size budget. Safe for several servers that share the folder.
//!
//! `CACHE/git/NAME` is a bare repository, `NAME.use` is locked (shared) by everybody who uses it, `NAME.fetch` is
//! locked by whoever changes it for as long as that takes; fetches work aside (see [`super::quarantine`]). The time of the `.use` file says when a repository was used last.
//! `NAME.damaged` marks a repository that is broken while others still use it: whoever comes takes the next one,
//! `NAME~1`, and the broken one is removed when the last has left (see [`super::housekeeping`]).

use std::fs::File;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::SystemTime;

use super::cache_lock::{Departure, Work, beside, is_there, lock_file, remove_locks, wait};
use super::cached_repository::{Fetching, InUse};
use super::quarantine;

/// The folder of cached repositories.
#[derive(Debug, Clone)]
pub struct RepositoryCache {
    folder: PathBuf,
    budget: u64,
    work: Arc<Work>,
}

/// What a look at the cache has found.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Survey {
    /// Repositories that were removed.
    pub removed: usize,
    /// How many bytes are left above the budget.
    pub excess: u64,
    /// The repositories that are left, the largest first.
    pub left: Vec<PathBuf>,
}

/// A repository for [`RepositoryCache::mend`].
#[derive(Debug)]
pub enum Patient {
    /// Nobody else uses it.
    Alone {
        /// Where it is.
        path: PathBuf,
        /// Keeps others away.
        lock: File,
    },
    /// Others use it too.
    Shared(InUse, Fetching),
}

/// So many broken repositories of one remote may wait for their users to leave.
const MOST_GENERATIONS: usize = 100;

impl RepositoryCache {
    /// Opens the cache below `folder`, which may take `budget` bytes.
    ///
    /// # Errors
    /// When the folder can't be made.
    pub fn open(folder: &Path, budget: u64) -> io::Result<Self> {
        let folder = folder.join("git");
        std::fs::create_dir_all(&folder)?;
        Ok(Self { folder: folder.canonicalize()?, budget, work: Arc::default() })
    }

    /// Takes a repository into use. It may not exist yet: then its path is where it belongs.
    ///
    /// # Errors
    /// When its lock can't be opened.
    pub async fn take(&self, location: &str) -> io::Result<InUse> {
        loop {
            let path = self.current(location)?;
            let lock = lock_file(&path, "use")?;
            wait(|| lock.try_lock_shared()).await?;
            if !is_there(&path, "use", &lock) {
                continue;
            }
            lock.set_modified(SystemTime::now())?;
            let repository = InUse::new(path, lock, Departure(Arc::clone(&self.work)));
            if !beside(repository.path(), "damaged").exists() {
                return Ok(repository);
            }
        }
    }

    /// Takes a repository into use for a look at it, unless it is being removed. Nobody is told when that ends.
    #[must_use]
    pub fn visit(&self, path: &Path) -> Option<InUse> {
        let lock = lock_file(path, "use").ok()?;
        lock.try_lock_shared().ok()?;
        if !is_there(path, "use", &lock) {
            return None;
        }
        Some(InUse::new(path.to_owned(), lock, Departure(Arc::default())))
    }

    /// Takes a repository for [`RepositoryCache::mend`]: alone, if nobody else uses it.
    ///
    /// # Errors
    /// When its locks can't be opened.
    pub async fn examine(&self, location: &str) -> io::Result<Patient> {
        let path = self.current(location)?;
        let lock = lock_file(&path, "use")?;
        if lock.try_lock().is_ok() && is_there(&path, "use", &lock) {
            return Ok(Patient::Alone { path, lock });
        }
        let repository = self.take(location).await?;
        let fetching = repository.fetching().await?;
        Ok(Patient::Shared(repository, fetching))
    }

    /// Removes a repository that was found to be damaged. While others use it, it is only put aside.
    ///
    /// # Errors
    /// When that can't be done.
    pub async fn mend(&self, patient: Patient) -> io::Result<()> {
        match patient {
            Patient::Alone { path, lock } => {
                let removed = tokio::fs::remove_dir_all(path).await;
                drop(lock);
                removed
            }
            Patient::Shared(repository, fetching) => {
                File::create(beside(repository.path(), "damaged"))?;
                self.work.left_over.store(true, Ordering::Relaxed);
                drop((fetching, repository));
                Ok(())
            }
        }
    }

    /// Says that something was added.
    pub fn grown(&self) {
        self.work.wake.notify_one();
    }

    /// Waits until there may be something to tidy up.
    pub async fn change(&self) {
        self.work.wake.notified().await;
    }

    /// Removes what is damaged, and the repositories that were not used for longest until all fit into the budget.
    /// Those in use stay. Reads the whole folder: not for a thread that serves others.
    #[must_use]
    pub fn shrink(&self) -> Survey {
        let mut survey = Survey::default();
        let Ok(entries) = std::fs::read_dir(&self.folder) else {
            return survey;
        };
        let locks = entries.flatten().map(|entry| entry.path());
        let locks = locks.filter(|path| path.extension().is_some_and(|extension| extension == "use"));
        let mut repositories: Vec<(bool, SystemTime, u64, PathBuf)> = locks
            .filter_map(|lock| {
                let used = lock.metadata().and_then(|about| about.modified()).ok()?;
                let path = lock.with_extension("");
                if let Some(repository) = self.visit(&path) {
                    repository.tidy_up();
                    quarantine::sweep(repository.path());
                }
                Some((!beside(&path, "damaged").exists(), used, size_of(&path), path))
            })
            .collect();
        repositories.sort();
        let mut total: u64 = repositories.iter().map(|(_, _, size, _)| size).sum();
        let mut left = Vec::new();
        let mut is_mended = true;
        for (is_sound, _, size, path) in repositories {
            let must_go = !is_sound || (total > self.budget && size > 0);
            if must_go && remove_unused(&path) {
                log::info!("removed {} from the cache", path.display());
                total -= size;
                survey.removed += 1;
            } else {
                is_mended &= is_sound;
                left.push((size, path));
            }
        }
        left.sort();
        survey.left = left.into_iter().rev().filter(|(size, _)| *size > 0).map(|(_, path)| path).collect();
        survey.excess = total.saturating_sub(self.budget);
        self.work.left_over.store(survey.excess > 0 || !is_mended, Ordering::Relaxed);
        survey
    }

    /// Where the repository of a remote is, or belongs: the first that is not known as damaged.
    fn current(&self, location: &str) -> io::Result<PathBuf> {
        let name = file_name(location);
        let generations = (1..MOST_GENERATIONS).map(|generation| self.folder.join(format!("{name}~{generation}")));
        let mut all = std::iter::once(self.folder.join(&name)).chain(generations);
        let sound = all.find(|path| !beside(path, "damaged").exists());
        sound.ok_or_else(|| io::Error::other("what is cached of it was damaged too often"))
    }
}

/// Removes a repository unless somebody uses it.
fn remove_unused(path: &Path) -> bool {
    let Ok(lock) = lock_file(path, "use") else {
        return false;
    };
    if lock.try_lock().is_err() || !is_there(path, "use", &lock) {
        return false;
    }
    let removed = match std::fs::remove_dir_all(path) {
        Err(error) => error.kind() == io::ErrorKind::NotFound,
        Ok(()) => true,
    };
    // What is gone is no longer damaged; the mark must not outlive it, nor go before it.
    let gone = removed
        && std::fs::remove_file(beside(path, "damaged"))
            .map_or_else(|error| error.kind() == io::ErrorKind::NotFound, |()| true);
    remove_locks(path, &lock);
    gone
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
    use super::super::cached_repository::received;
    use super::*;
    use std::time::Duration;

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
        assert_eq!(cache.shrink().removed, 1);
        let exists = |name| cache.folder.join(file_name(name)).exists();
        assert!(exists("in use") && !exists("old") && exists("new"));
    }

    #[actix_rt::test]
    async fn only_one_changes_it_at_a_time_and_finds_no_rest_of_another() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1).unwrap();
        let one = cache.take("x").await.unwrap();
        let other = cache.take("x").await.unwrap();
        let packs = one.path().join("objects/pack");
        std::fs::create_dir_all(&packs).unwrap();
        let fetching = one.fetching().await.unwrap();
        std::fs::write(packs.join("tmp_pack_x"), [0; 10]).unwrap();
        assert_eq!(received(other.path()), 10);
        let soon = Duration::from_millis(60);
        assert!(actix_rt::time::timeout(soon, other.fetching()).await.is_err());
        drop(fetching);
        let _fetching = other.fetching().await.unwrap();
        assert_eq!(received(other.path()), 0);
    }

    #[actix_rt::test]
    async fn what_is_damaged_stays_as_long_as_it_is_used_and_nobody_new_gets_it() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1000).unwrap();
        let user = cache.take("x").await.unwrap();
        std::fs::create_dir(user.path()).unwrap();
        let patient = cache.examine("x").await.unwrap();
        assert!(matches!(patient, Patient::Shared(..)));
        cache.mend(patient).await.unwrap();
        let next = cache.take("x").await.unwrap();
        assert!(next.path() != user.path() && user.path().exists());
        let old = user.path().to_owned();
        assert_eq!(cache.shrink().removed, 0);
        drop(user);
        assert_eq!(cache.shrink().removed, 1);
        assert!(!old.exists() && cache.take("x").await.unwrap().path() == old);
        assert!(matches!(cache.examine("x").await.unwrap(), Patient::Alone { .. }));
    }

    #[actix_rt::test]
    async fn a_repository_that_was_never_there_leaves_nothing_and_its_lock_is_never_one_that_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1000).unwrap();
        let count = || std::fs::read_dir(&cache.folder).unwrap().count();
        let (one, other) = (cache.take("x").await.unwrap(), cache.take("x").await.unwrap());
        drop(one.fetching().await.unwrap());
        drop(one);
        assert_eq!(count(), 2, "somebody still uses it");
        // Somebody has opened the file and not locked it yet.
        let late = lock_file(other.path(), "use").unwrap();
        let path = other.path().to_owned();
        drop(other);
        assert_eq!(count(), 0);
        late.try_lock_shared().unwrap();
        assert!(!is_there(&path, "use", &late));
        let taken = cache.take("x").await.unwrap();
        std::fs::create_dir(taken.path()).unwrap();
        drop(taken);
        assert_eq!(count(), 2, "it is there");
    }

    #[test]
    fn names_are_short_readable_and_unique() {
        let name = file_name("https://github.com/lab/arm.git");
        assert!(name.starts_with("https---github-com-lab-arm-git-"), "{name}");
        assert_ne!(file_name(&format!("{}a", "x".repeat(300))), file_name(&format!("{}b", "x".repeat(300))));
        assert!(file_name(&"x".repeat(2000)).len() < 200);
    }
}
