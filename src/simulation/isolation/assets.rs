//! The assets (PROTOs, textures, meshes) that Webots downloads, kept for the next simulation of the same repository.
//!
//! The home of a sandbox is empty, so that each Webots would download again. `assets/NAME` in `cacheDir` has the assets
//! of one repository; its mtime is its last use. A sandbox shows that directory read-only, and Webots' own directory
//! has symlinks to its files. When a simulation that was ready has ended, the server copies what is new there.
//!
//! Webots names an asset by the SHA-1 of its URL, which says nothing about its contents: a world's program can put
//! anything there. Therefore no assets are shared between repositories: a world can spoil those of its own only.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Read};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};
use std::time::SystemTime;

use nix::dir::Dir;
use nix::fcntl::{OFlag, openat};
use nix::sys::stat::Mode;
use parking_lot::Mutex;
use sha2::{Digest, Sha256};

use crate::simulation::process::disk_usage::DiskRoom;
use crate::simulation::process::has_several_runs;

/// The assets of all repositories.
pub struct AssetCache {
    folder: PathBuf,
    /// Size limit of all, in bytes.
    limit: u64,
    /// Free room that the disk must keep, in bytes.
    reserve: u64,
    /// The directories in use, which are not evicted.
    in_use: Mutex<HashMap<PathBuf, Weak<RepositoryAssets>>>,
}

/// The assets of one repository; in use until this is dropped.
pub struct RepositoryAssets {
    /// Their directory.
    pub folder: PathBuf,
}

/// Where Webots keeps assets, below a home.
const OF_WEBOTS: [&str; 4] = [".cache", "Cyberbotics", "Webots", "assets"];
/// A repository may fill 1/`PARTS` of the limit, so that it can't evict all others.
const PARTS: u64 = 4;
/// Number of files that are looked at in a home, and of those that a repository has.
const MOST_FILES: usize = 10_000;

impl AssetCache {
    /// The cache in `cacheDir`, a canonical path; `limit` and `reserve` are in MiB.
    pub fn new(cache: &Path, limit: u64, reserve: u64) -> Self {
        Self {
            folder: cache.join("assets"),
            limit: limit << 20,
            reserve: reserve << 20,
            in_use: Mutex::default(),
        }
    }

    /// The assets of the repository with this URL.
    ///
    /// # Errors
    /// When their directory can't be created.
    pub fn of(&self, repository: &str) -> io::Result<Arc<RepositoryAssets>> {
        let folder = self.folder.join(hex::encode(Sha256::digest(repository)));
        let mut in_use = self.in_use.lock();
        in_use.retain(|_, assets| assets.strong_count() > 0);
        fs::create_dir_all(&folder)?;
        File::open(&folder)?.set_modified(SystemTime::now())?;
        if let Some(assets) = in_use.get(&folder).and_then(Weak::upgrade) {
            return Ok(assets);
        }
        let assets = Arc::new(RepositoryAssets { folder: folder.clone() });
        in_use.insert(folder, Arc::downgrade(&assets));
        Ok(assets)
    }

    /// Copies what Webots has downloaded into this home. If there was something new, evicts what exceeds the limit.
    /// Blocks.
    pub fn adopt(&self, assets: &RepositoryAssets, home: &Path) {
        let before = files_of(&assets.folder).len();
        if let Err(error) = self.copy_new(assets, home) {
            log::debug!("not all assets in {} are kept: {error}", home.display());
        }
        if files_of(&assets.folder).len() > before {
            self.shrink();
        }
    }

    /// Copies regular files with the name of an asset. What a world's program has left may be anything else: symlinks
    /// are not followed, and nothing is opened that would block.
    fn copy_new(&self, assets: &RepositoryAssets, home: &Path) -> io::Result<()> {
        let flags = OFlag::O_RDONLY | OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC;
        let mut there = File::open(home)?;
        for name in OF_WEBOTS {
            there = openat(&there, name, flags | OFlag::O_DIRECTORY, Mode::empty())?.into();
        }
        let mut files = Dir::from_fd(there.try_clone()?.into())?;
        let known = files_of(&assets.folder);
        let mut left = (self.limit / PARTS).saturating_sub(known.iter().map(|(_, size)| size).sum());
        let mut room = MOST_FILES.saturating_sub(known.len());
        for file in files.iter().take(MOST_FILES) {
            let file = file?;
            let Some(name) = file.file_name().to_str().ok().filter(|name| is_asset(name)) else {
                continue;
            };
            let to = assets.folder.join(name);
            if room == 0 || to.exists() {
                continue;
            }
            let Ok(from) = openat(&there, name, flags, Mode::empty()).map(File::from) else {
                continue;
            };
            let about = from.metadata()?;
            if !about.is_file() || about.len() > left {
                continue;
            }
            if DiskRoom::of(&assets.folder)?.bytes < self.reserve.saturating_add(about.len()) {
                return Err(io::ErrorKind::StorageFull.into());
            }
            let mut copy = tempfile::NamedTempFile::new_in(&assets.folder)?;
            left -= io::copy(&mut from.take(about.len()), &mut copy)?;
            room -= 1;
            copy.persist(to)?;
        }
        Ok(())
    }

    /// Evicts the assets of repositories not in use, least recently used first, until the others fit into the limit.
    fn shrink(&self) {
        if self.folder.parent().is_some_and(has_several_runs) {
            return;
        }
        let mut all: Vec<(SystemTime, u64, PathBuf)> = Vec::new();
        for entry in fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            if let Ok(used) = entry.metadata().and_then(|about| about.modified()) {
                let size = files_of(&entry.path()).iter().map(|(_, size)| size).sum();
                all.push((used, size, entry.path()));
            }
        }
        all.sort();
        let mut total: u64 = all.iter().map(|(_, size, _)| size).sum();
        for (_, size, folder) in all {
            if total <= self.limit {
                return;
            }
            // New users wait for the lock, and then create the directory again.
            let in_use = self.in_use.lock();
            if in_use.get(&folder).is_some_and(|assets| assets.strong_count() > 0) {
                continue;
            }
            match fs::remove_dir_all(&folder) {
                Ok(()) => total -= size,
                Err(error) => log::warn!("{} can't be removed: {error}", folder.display()),
            }
        }
    }
}

impl RepositoryAssets {
    /// Gives Webots these assets: symlinks in the home of a simulation, which lead to the directory itself.
    ///
    /// # Errors
    /// When a directory or a symlink can't be created.
    pub fn offer(&self, home: &Path) -> io::Result<()> {
        let webots: PathBuf = std::iter::once(home).chain(OF_WEBOTS.map(Path::new)).collect();
        fs::create_dir_all(&webots)?;
        for (name, _) in files_of(&self.folder).iter().filter(|(name, _)| is_asset(name)) {
            symlink(self.folder.join(name), webots.join(name))?;
        }
        Ok(())
    }
}

/// Whether this is the name of an asset: a SHA-1.
fn is_asset(name: &str) -> bool {
    name.len() == 40 && name.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// The files of a directory that only this server writes, with their sizes.
fn files_of(folder: &Path) -> Vec<(String, u64)> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .filter_map(|entry| Some((entry.file_name().into_string().ok()?, entry.metadata().ok()?.len())))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A home in which Webots has downloaded an asset of this many bytes.
    fn home(bytes: u64) -> tempfile::TempDir {
        let home = tempfile::tempdir().unwrap();
        let folder: PathBuf = std::iter::once(home.path()).chain(OF_WEBOTS.map(Path::new)).collect();
        fs::create_dir_all(&folder).unwrap();
        File::create(folder.join("a".repeat(40)))
            .unwrap()
            .set_len(bytes)
            .unwrap();
        home
    }

    #[test]
    fn assets_are_evicted_by_last_use_but_not_under_a_simulation() {
        let place = tempfile::tempdir().unwrap();
        let cache = AssetCache::new(place.path(), 4, 0);
        let used = cache.of("used").unwrap();
        let mut folders = Vec::new();
        for name in ["used", "old", "new", "newer", "newest"] {
            let assets = cache.of(name).unwrap();
            cache.copy_new(&assets, home(1 << 20).path()).unwrap();
            let at = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(folders.len() as u64);
            File::open(&assets.folder).unwrap().set_modified(at).unwrap();
            folders.push(assets.folder.clone());
        }
        cache.shrink();
        let there: Vec<bool> = folders.iter().map(|folder| folder.exists()).collect();
        assert_eq!(there, [true, false, true, true, true]);
        assert_eq!(files_of(&used.folder).len(), 1);
    }

    #[test]
    fn a_repository_has_a_share_and_the_disk_its_reserve() {
        let place = tempfile::tempdir().unwrap();
        let cache = AssetCache::new(place.path(), 4, 0);
        let assets = cache.of("one").unwrap();
        cache.copy_new(&assets, home((1 << 20) + 1).path()).unwrap();
        assert!(files_of(&assets.folder).is_empty(), "it is larger than the share");
        let full = AssetCache::new(place.path(), 4, 1 << 40);
        assert!(full.copy_new(&assets, home(1).path()).is_err());
        assert!(files_of(&assets.folder).is_empty(), "the disk has no room");
    }
}
