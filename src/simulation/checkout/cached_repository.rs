//! One cached repository that is in use: its commits, and what is added to it.

use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::cache_lock::{Departure, lock_file, remove_locks, wait};

/// A cached repository that is in use: as long as this lives it is not removed.
#[derive(Debug)]
pub struct InUse {
    path: PathBuf,
    // Fields are dropped in this order: it is told that it is free when it is.
    lock: File,
    _departure: Departure,
}

/// The right to change a cached repository: to add what was fetched, or to tidy it up.
#[derive(Debug)]
pub struct Fetching {
    _lock: File,
}

/// A commit that is in use: as long as this lives it is not removed from its repository.
#[derive(Debug)]
pub struct CommitInUse {
    _lock: File,
}

/// Where the fetched commits are named: those that the repository's owner vouches for, and others.
const COMMITS: [&str; 2] = ["refs/fleet", "refs/any"];

/// Nobody is told of a wait that is no longer than this.
const MOMENT: Duration = Duration::from_millis(500);

impl Drop for InUse {
    fn drop(&mut self) {
        // A repository that could not be had leaves nothing behind.
        remove_locks(&self.path, &self.lock);
    }
}

impl InUse {
    /// The repository at this path, whose lock is held.
    #[must_use]
    pub fn new(path: PathBuf, lock: File, departure: Departure) -> Self {
        Self { path, lock, _departure: departure }
    }

    /// Where the bare repository is, or belongs.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Waits for the right to change the repository, and removes what a broken fetch has left.
    ///
    /// # Errors
    /// When its lock can't be opened.
    pub async fn fetching(&self) -> io::Result<Fetching> {
        let lock = lock_file(&self.path, "fetch")?;
        wait(|| lock.try_lock()).await?;
        self.clean();
        Ok(Fetching { _lock: lock })
    }

    /// The same. `tell` is called where that takes its time.
    ///
    /// # Errors
    /// When its lock can't be opened.
    pub async fn fetching_later(&self, tell: impl FnOnce()) -> io::Result<Fetching> {
        let mut right = std::pin::pin!(self.fetching());
        if let Ok(right) = actix_rt::time::timeout(MOMENT, &mut right).await {
            return right;
        }
        tell();
        right.await
    }

    /// The same if nobody else has that right now.
    #[must_use]
    pub fn try_fetching(&self) -> Option<Fetching> {
        let lock = lock_file(&self.path, "fetch").ok()?;
        lock.try_lock().ok()?;
        self.clean();
        Some(Fetching { _lock: lock })
    }

    fn clean(&self) {
        for broken in incoming(&self.path).chain(unfinished(&self.path)).chain(self.locks()) {
            std::fs::remove_file(broken).ok();
        }
    }

    /// Removes what a broken fetch has left, unless one is under way.
    pub fn tidy_up(&self) {
        if incoming(&self.path).chain(unfinished(&self.path)).next().is_some() {
            drop(self.try_fetching());
        }
    }

    /// Locks that git leaves behind when it is killed: each would make every later fetch fail.
    fn locks(&self) -> impl Iterator<Item = PathBuf> {
        let mut open = vec![self.path.join("refs")];
        let mut all: Vec<PathBuf> = files(self.path.clone()).collect();
        while let Some(folder) = open.pop() {
            for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
                let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
                if is_folder { &mut open } else { &mut all }.push(entry.path());
            }
        }
        all.into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "lock"))
    }

    /// Whether the bare repository is there.
    #[must_use]
    pub fn is_made(&self) -> bool {
        self.path.join("HEAD").is_file()
    }

    /// Takes a commit into use that was fetched with all that belongs to it.
    #[must_use]
    pub fn commit(&self, reference: &str) -> Option<CommitInUse> {
        let path = self.path.join(reference);
        let file = File::options().append(true).open(&path).ok()?;
        file.try_lock_shared().ok()?;
        // It may have been removed before it was locked.
        let is_same = path.metadata().is_ok_and(|there| file.metadata().is_ok_and(|here| there.ino() == here.ino()));
        file.set_modified(SystemTime::now()).ok()?;
        is_same.then_some(CommitInUse { _lock: file })
    }

    /// Names a commit that was handed over by the file in which its fetch has named it, and takes it into use.
    #[must_use]
    pub fn name(&self, _right: &Fetching, incoming: &Path, reference: &str) -> Option<CommitInUse> {
        // Who uses a commit has locked its file, which must not be replaced.
        if let Some(known) = self.commit(reference) {
            return Some(known);
        }
        let path = self.path.join(reference);
        std::fs::create_dir_all(path.parent()?).ok()?;
        std::fs::rename(incoming, path).ok()?;
        self.commit(reference)
    }

    /// How many commits there are.
    #[must_use]
    pub fn commits(&self) -> usize {
        self.commit_files().count()
    }

    /// How many packs there are: each fetch adds one.
    #[must_use]
    pub fn packs(&self) -> usize {
        self.pack_files().count()
    }

    /// How many bytes the packs have.
    #[must_use]
    pub fn packed(&self) -> u64 {
        self.pack_files().filter_map(|path| path.metadata().ok()).map(|about| about.len()).sum()
    }

    fn pack_files(&self) -> impl Iterator<Item = PathBuf> {
        let is_pack = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "pack");
        files(self.path.join("objects/pack")).filter(is_pack)
    }

    /// Forgets the commits that were not used for longest, and keeps so many. Those in use stay. Gives back how many
    /// were forgotten; their objects are still there.
    #[must_use]
    pub fn forget(&self, _right: &Fetching, keep: usize) -> usize {
        let mut commits: Vec<(SystemTime, PathBuf)> =
            self.commit_files().filter_map(|path| Some((path.metadata().ok()?.modified().ok()?, path))).collect();
        commits.sort();
        let spare = commits.len().saturating_sub(keep);
        let is_forgotten = |path: &PathBuf| {
            let file = File::options().append(true).open(path);
            file.is_ok_and(|file| file.try_lock().is_ok() && std::fs::remove_file(path).is_ok())
        };
        commits.into_iter().map(|(_, path)| path).filter(is_forgotten).take(spare).count()
    }

    /// The files that name the commits.
    pub fn commit_files(&self) -> impl Iterator<Item = PathBuf> {
        let is_commit = |path: &PathBuf| path.extension().is_none();
        COMMITS.map(|folder| self.path.join(folder)).into_iter().flat_map(files).filter(is_commit)
    }
}

/// How many bytes a fetch that is under way in a repository has received.
#[must_use]
pub fn received(repository: &Path) -> u64 {
    incoming(repository).filter_map(|path| path.metadata().ok()).map(|about| about.len()).sum()
}

/// Packs that are being received or made, or were when git was ended.
fn incoming(repository: &Path) -> impl Iterator<Item = PathBuf> {
    let is_new = |name: &[u8]| name.starts_with(b"tmp_") || name.starts_with(b".tmp-");
    let files = files(repository.join("objects/pack"));
    files.filter(move |path| path.file_name().is_some_and(|name| is_new(name.as_encoded_bytes())))
}

/// Packs without an index, and what belongs to them: nobody finds these. They are there while somebody adds or removes
/// a pack, or was ended at that.
fn unfinished(repository: &Path) -> impl Iterator<Item = PathBuf> {
    let is_pack = |path: &PathBuf| path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"pack-"));
    let files = files(repository.join("objects/pack")).filter(is_pack);
    files.filter(|path| path.with_extension("idx").try_exists().is_ok_and(|is_there| !is_there))
}

/// The object that the file of a reference names.
#[must_use]
pub fn arrived(reference: &Path) -> Option<String> {
    let hash = std::fs::read_to_string(reference).ok()?;
    let hash = hash.trim_end();
    (hash.len() >= 40 && hash.bytes().all(|byte| byte.is_ascii_hexdigit())).then(|| hash.to_owned())
}

/// What is in a folder.
pub fn files(folder: PathBuf) -> impl Iterator<Item = PathBuf> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}
