//! Blocking file I/O on cached repositories.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::simulation::process::disk_usage::{self, DiskUsage};
use crate::simulation::process::remove_tree;

/// Interval between two checks of the written size.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);

/// Runs blocking file I/O on the blocking thread pool.
///
/// # Errors
/// Those of `work`.
pub async fn blocking<T: Send + 'static>(work: impl FnOnce() -> io::Result<T> + Send + 'static) -> io::Result<T> {
    actix_rt::task::spawn_blocking(work).await?
}

/// Removes what a killed git has left: a lock that would make every later fetch fail, and incomplete packs.
///
/// # Errors
/// When that can't be done.
pub fn remove_leftovers(repository: &Path) -> io::Result<()> {
    let lock = repository.join("shallow.lock");
    for path in unfinished(repository).chain(std::iter::once(lock)) {
        absent(fs::remove_file(path))?;
    }
    Ok(())
}

/// Removes those of these directories that exist, with their contents.
///
/// # Errors
/// When that can't be done.
pub fn remove_all(folders: &[&Path]) -> io::Result<()> {
    folders.iter().try_for_each(|folder| remove_tree(folder))
}

/// Treats `NotFound` as success.
fn absent(result: io::Result<()>) -> io::Result<()> {
    result.or_else(|error| if error.kind() == io::ErrorKind::NotFound { Ok(()) } else { Err(error) })
}

/// The packs that are being received or written.
fn unfinished(repository: &Path) -> impl Iterator<Item = PathBuf> {
    let is_new = |name: &[u8]| name.starts_with(b"tmp_") || name.starts_with(b".tmp-");
    let all = fs::read_dir(repository.join("objects/pack")).into_iter().flatten().flatten();
    all.filter(move |entry| is_new(entry.file_name().as_encoded_bytes())).map(|entry| entry.path())
}

/// Waits until one of the directories exceeds its limit, in bytes, or has one in it that can't be read.
pub async fn outgrown(folders: Vec<(PathBuf, u64)>) {
    loop {
        actix_rt::time::sleep(CHECK_INTERVAL).await;
        let looked_at = folders.clone();
        let is_one = move || Ok(looked_at.iter().any(|(folder, most)| is_beyond(folder, *most)));
        if blocking(is_one).await.is_ok_and(|is_one| is_one) {
            return;
        }
    }
}

fn is_beyond(folder: &Path, most: u64) -> bool {
    let mut size = DiskUsage::new(measure, most);
    size.add_folder(folder).is_err() || size.total() > most
}

/// What everything below a folder takes, each file and folder at least what a name takes of a disk. What nobody can look
/// into does not count.
pub fn room_of(folder: &Path) -> u64 {
    sum(folder, measure)
}

/// The bytes of all files below a folder.
pub fn size_of(folder: &Path) -> u64 {
    sum(folder, disk_usage::length)
}

fn measure(about: &fs::Metadata) -> u64 {
    disk_usage::length(about).max(disk_usage::room(about))
}

fn sum(folder: &Path, measure: fn(&fs::Metadata) -> u64) -> u64 {
    let mut size = DiskUsage::new(measure, u64::MAX);
    size.add_folder(folder).ok();
    size.total()
}
