//! Where one fetch works: a bare repository of its own inside a cached one, whose objects it borrows. So a fetch that
//! hangs, fails or is killed touches nothing that others need; what it has brought is handed over in a moment.
//!
//! `NAME/quarantine/HASH` is that repository, and `HASH.lock` is locked by whoever fetches that commit: others who
//! want the same wait for it, also those of another server. What nobody holds is the rest of a fetch that has ended.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use super::cache_lock::{beside, is_there, lock_file, wait};
use super::cached_repository::{Fetching, InUse, arrived, files};

/// One fetch's repository. What is left of it is removed by whoever tidies up: that may take a while.
#[derive(Debug)]
pub struct Quarantine {
    path: PathBuf,
    _lock: File,
}

/// Where they are in a cached repository.
const FOLDER: &str = "quarantine";
/// The objects of the cached repository, as seen from those of a quarantine.
const BORROWED: &str = "../../../objects\n";
/// What is taken over from the cached repository as it is.
const COPIED: [&str; 3] = ["HEAD", "config", "shallow"];

impl Quarantine {
    /// Waits until nobody fetches the same into a repository.
    ///
    /// # Errors
    /// When its lock can't be opened, or what a broken fetch has left can't be removed.
    pub async fn enter(repository: &InUse, commit: &str) -> io::Result<Self> {
        let path = repository.path().join(FOLDER).join(commit);
        loop {
            std::fs::create_dir_all(repository.path().join(FOLDER))?;
            let lock = lock_file(&path, "lock")?;
            wait(|| lock.try_lock()).await?;
            if is_there(&path, "lock", &lock) {
                absent(tokio::fs::remove_dir_all(&path).await)?;
                return Ok(Self { path, _lock: lock });
            }
        }
    }

    /// Where it is.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Makes the repository. It knows the commits that are there, so that only what is new is fetched.
    ///
    /// # Errors
    /// When it can't be made.
    pub fn make(&self, repository: &InUse, _right: &Fetching) -> io::Result<()> {
        std::fs::create_dir_all(self.path.join("objects/info"))?;
        std::fs::create_dir(self.path.join("refs"))?;
        std::fs::write(self.path.join("objects/info/alternates"), BORROWED)?;
        for name in COPIED {
            absent(std::fs::copy(repository.path().join(name), self.path.join(name)).map(drop))?;
        }
        let known = repository.commit_files().filter_map(|path| {
            let name = path.strip_prefix(repository.path()).ok()?.to_str()?.to_owned();
            Some(format!("{} {name}\n", arrived(&path)?))
        });
        std::fs::write(self.path.join("packed-refs"), known.collect::<String>())
    }

    /// Hands over the objects that have come. They have no name yet.
    ///
    /// # Errors
    /// When the disk fails.
    pub fn hand_over(&self, repository: &InUse, _right: &Fetching) -> io::Result<()> {
        // First of all it must be known that the commits' ancestors are missing on purpose.
        let there = repository.path().join("shallow");
        let (known, came) = (text_of(&there)?, text_of(&self.path.join("shallow"))?);
        let new: String = came.split_inclusive('\n').filter(|line| !known.contains(*line)).collect();
        if !new.is_empty() {
            let whole = there.with_extension("new");
            std::fs::write(&whole, known + &new)?;
            std::fs::rename(whole, there)?;
        }
        // A pack is found by its index.
        let is_index = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "idx");
        let (indexes, packs): (Vec<_>, Vec<_>) = packs_of(&self.path)?.into_iter().partition(is_index);
        let target = repository.path().join("objects/pack");
        std::fs::create_dir_all(&target)?;
        for file in packs.into_iter().chain(indexes) {
            std::fs::rename(&file, target.join(file.file_name().unwrap_or_default()))?;
        }
        Ok(())
    }
}

/// Removes what fetches into a repository have left that have ended. Gives back how many are under way.
pub fn sweep(repository: &Path) -> usize {
    let mut under_way = 0;
    let mut all: Vec<PathBuf> = files(repository.join(FOLDER)).map(|path| path.with_extension("")).collect();
    all.sort();
    all.dedup();
    for path in all {
        let Ok(lock) = lock_file(&path, "lock") else {
            continue;
        };
        if lock.try_lock().is_err() {
            under_way += 1;
        } else if is_there(&path, "lock", &lock) && absent(std::fs::remove_dir_all(&path)).is_ok() {
            std::fs::remove_file(beside(&path, "lock")).ok();
        }
    }
    under_way
}

/// The text of a file; nothing where there is none.
fn text_of(path: &Path) -> io::Result<String> {
    let text = std::fs::read_to_string(path);
    text.or_else(|error| if error.kind() == io::ErrorKind::NotFound { Ok(String::new()) } else { Err(error) })
}

/// The packs that have come, if there are any, and what belongs to them.
fn packs_of(repository: &Path) -> io::Result<Vec<PathBuf>> {
    match std::fs::read_dir(repository.join("objects/pack")) {
        Ok(entries) => entries.map(|entry| Ok(entry?.path())).collect(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(error) => Err(error),
    }
}

/// What is not there need not be removed or copied.
fn absent(result: io::Result<()>) -> io::Result<()> {
    result.or_else(|error| if error.kind() == io::ErrorKind::NotFound { Ok(()) } else { Err(error) })
}

#[cfg(test)]
mod tests {
    use super::super::repository_cache::RepositoryCache;
    use super::*;
    use std::time::Duration;

    const A: &str = "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa";
    const B: &str = "bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb";

    #[actix_rt::test]
    async fn different_commits_are_fetched_side_by_side_and_equal_ones_one_after_the_other() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1000).unwrap();
        let repository = cache.take("x").await.unwrap();
        let one = Quarantine::enter(&repository, A).await.unwrap();
        let other = Quarantine::enter(&repository, B).await.unwrap();
        let soon = Duration::from_millis(60);
        assert!(actix_rt::time::timeout(soon, Quarantine::enter(&repository, A)).await.is_err());
        let right = repository.fetching().await.unwrap();
        one.make(&repository, &right).unwrap();
        assert_eq!(sweep(repository.path()), 2);
        assert!(one.path().join("objects").exists(), "it is in use");
        let path = one.path().to_owned();
        drop(one);
        let again = Quarantine::enter(&repository, A).await.unwrap();
        assert!(!path.exists(), "it finds the rest of another");
        again.make(&repository, &right).unwrap();
        drop((again, other));
        assert_eq!(sweep(repository.path()), 0);
        assert_eq!(files(repository.path().join(FOLDER)).count(), 0);
    }

    #[actix_rt::test]
    async fn what_is_known_to_be_shallow_stays_so_and_is_told_once() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1000).unwrap();
        let repository = cache.take("x").await.unwrap();
        let right = repository.fetching().await.unwrap();
        let shallow = repository.path().join("shallow");
        let quarantines =
            [Quarantine::enter(&repository, A).await.unwrap(), Quarantine::enter(&repository, B).await.unwrap()];
        for (quarantine, commit) in quarantines.iter().zip([A, B]) {
            quarantine.make(&repository, &right).unwrap();
            std::fs::write(quarantine.path().join("shallow"), format!("{commit}\n")).unwrap();
        }
        for quarantine in quarantines.iter().chain(&quarantines) {
            quarantine.hand_over(&repository, &right).unwrap();
        }
        assert_eq!(std::fs::read_to_string(shallow).unwrap(), format!("{A}\n{B}\n"));
    }
    #[actix_rt::test]
    async fn what_cannot_be_read_is_not_taken_for_empty() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1000).unwrap();
        let repository = cache.take("x").await.unwrap();
        let right = repository.fetching().await.unwrap();
        let quarantine = Quarantine::enter(&repository, A).await.unwrap();
        quarantine.make(&repository, &right).unwrap();
        let (known, came) = (repository.path().join("shallow"), quarantine.path().join("shallow"));
        let (text, unreadable): (_, &[u8]) = (format!("{A}\n"), &[0xff]);
        std::fs::write(&came, &text).unwrap();
        std::fs::write(&known, unreadable).unwrap();
        quarantine.hand_over(&repository, &right).unwrap_err();
        assert_eq!(std::fs::read(&known).unwrap(), unreadable, "it is as it was");
        std::fs::write(&known, &text).unwrap();
        std::fs::write(&came, unreadable).unwrap();
        quarantine.hand_over(&repository, &right).unwrap_err();
        std::fs::remove_file(&came).unwrap();
        let packs = quarantine.path().join("objects/pack");
        std::fs::write(&packs, "no folder").unwrap();
        quarantine.hand_over(&repository, &right).unwrap_err();
        std::fs::remove_file(&packs).unwrap();
        quarantine.hand_over(&repository, &right).unwrap();
    }

    #[actix_rt::test]
    async fn a_pack_that_was_handed_over_without_its_index_is_swept() {
        let folder = tempfile::tempdir().unwrap();
        let cache = RepositoryCache::open(folder.path(), 1000).unwrap();
        let repository = cache.take("x").await.unwrap();
        let packs = repository.path().join("objects/pack");
        std::fs::create_dir_all(&packs).unwrap();
        for name in ["pack-a.pack", "pack-a.rev", "pack-b.pack", "pack-b.rev", "pack-b.idx", "multi-pack-index"] {
            std::fs::write(packs.join(name), name).unwrap();
        }
        let there = || {
            let mut all: Vec<String> =
                files(packs.clone()).map(|path| path.file_name().unwrap().to_str().unwrap().to_owned()).collect();
            all.sort();
            all
        };
        let right = repository.fetching().await.unwrap();
        std::fs::write(packs.join("pack-c.pack"), "").unwrap();
        assert_eq!(cache.shrink().removed, 0);
        assert_eq!(repository.packs(), 2, "one is just being handed over");
        drop(right);
        assert_eq!(cache.shrink().removed, 0);
        assert_eq!(there(), ["multi-pack-index", "pack-b.idx", "pack-b.pack", "pack-b.rev"]);
    }
}
