//! Blocking file I/O on cached repositories.

use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{fs, io};

use crate::simulation::process::disk_usage::{self, DiskUsage};

/// Interval between two checks of the written size.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);

/// Locks that a killed git leaves. With the first two every later fetch fails, with the others every packing.
const LOCKS: [&str; 4] = ["shallow.lock", "config.lock", "packed-refs.lock", "gc.pid.lock"];

/// Runs blocking file I/O on the blocking thread pool.
///
/// # Errors
/// Those of `work`.
pub async fn spawn_blocking_io<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> io::Result<T> {
    actix_rt::task::spawn_blocking(work).await?
}

/// Whether a pack in the repository is incomplete and at least this large, in bytes.
pub fn has_unfinished_pack(repository: &Path, size: u64) -> bool {
    unfinished_packs(repository).any(|pack| pack.metadata().is_ok_and(|about| about.len() >= size))
}

/// Removes what a killed git has left: locks, and incomplete packs. No other git changes the repository meanwhile.
pub fn remove_leftovers(repository: &Path) {
    let locks = LOCKS.map(|name| repository.join(name));
    for path in unfinished_packs(repository).chain(locks) {
        // If one can't be removed, the fetch fails.
        fs::remove_file(path).ok();
    }
}

fn unfinished_packs(repository: &Path) -> impl Iterator<Item = PathBuf> {
    let is_unfinished = |name: &[u8]| name.starts_with(b"tmp_") || name.starts_with(b".tmp-");
    let packs = fs::read_dir(repository.join("objects/pack")).into_iter().flatten();
    packs
        .flatten()
        .filter(move |pack| is_unfinished(pack.file_name().as_encoded_bytes()))
        .map(|pack| pack.path())
}

/// Waits until one of these directories exceeds its limit of this moment, in bytes, or contains a directory that can't be
/// read.
pub async fn outgrown(limits: impl Fn() -> Vec<(PathBuf, u64)>) {
    loop {
        actix_rt::time::sleep(CHECK_INTERVAL).await;
        let looked_at = limits();
        let is_beyond = |(folder, most): &(PathBuf, u64)| {
            let mut size = DiskUsage::new(measure, *most);
            !size.add_folder(folder) || size.total > *most
        };
        if spawn_blocking_io(move || Ok(looked_at.iter().any(is_beyond)))
            .await
            .is_ok_and(|is_one| is_one)
        {
            return;
        }
    }
}

/// The size of everything below a directory: per file or directory its length or its disk usage, the larger of the two.
pub fn room_of(folder: &Path) -> u64 {
    sum(folder, measure)
}

fn measure(about: &fs::Metadata) -> u64 {
    disk_usage::length(about).max(disk_usage::room(about))
}

/// The sum of everything below a directory, without directories that can't be read.
pub fn sum(folder: &Path, measure: fn(&fs::Metadata) -> u64) -> u64 {
    let mut size = DiskUsage::new(measure, u64::MAX);
    size.add_folder(folder);
    size.total
}
