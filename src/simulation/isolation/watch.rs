//! Watches over what a running simulation takes: room on the disk, processes, ports.
//!
//! The kernel has no boundary for these that every machine offers to an ordinary user. So they are looked at every few
//! seconds, and a simulation that takes more than its share is ended.

use std::fs::DirEntry;
use std::ops::RangeInclusive;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::simulation::config::Resources;
use crate::simulation::machine::count_threads;
use crate::simulation::process::process_tree;

/// What is watched of one simulation.
#[derive(Debug)]
pub struct Watch {
    /// The process from which all of it descends.
    pub root: i32,
    /// The folder of the instance.
    pub folder: PathBuf,
    /// What it may take.
    pub limits: Resources,
    /// The ports of all simulations, of which one may be its own.
    pub ports: RangeInclusive<u16>,
}

/// Time between two looks, at least.
const PAUSE: Duration = Duration::from_secs(1);
/// So many times as long as a look takes is the time between two of them: no more than a fiftieth of a core goes into it.
const RARELY: u32 = 50;
/// The least that a file takes of the disk, in bytes.
const SMALLEST: u64 = 4096;

/// What a folder takes of the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Size {
    /// So many bytes.
    Bytes(u64),
    /// Nobody can tell: folders are closed, or nested deeper than the system lets anybody name.
    Unknown,
}

impl Watch {
    /// Waits until the simulation takes more than it may, and tells what, in words for its client.
    pub async fn until_too_much(self) -> String {
        let folder = self.folder.clone();
        let before = actix_rt::task::spawn_blocking(move || size_of(&folder)).await;
        let before = if let Ok(Size::Bytes(bytes)) = before { bytes } else { 0 };
        let watch = std::sync::Arc::new(self);
        let mut pause = PAUSE;
        loop {
            actix_rt::time::sleep(pause).await;
            let (begin, watch) = (Instant::now(), std::sync::Arc::clone(&watch));
            let found = actix_rt::task::spawn_blocking(move || watch.look(before)).await;
            if let Ok(Some(excess)) = found {
                return excess;
            }
            pause = PAUSE.max(begin.elapsed() * RARELY);
        }
    }

    /// Looks once. `before` is the size of the folder when the simulation began.
    fn look(&self, before: u64) -> Option<String> {
        let Resources { disk, processes, .. } = self.limits;
        match size_of(&self.folder) {
            Size::Bytes(bytes) if bytes <= before.saturating_add(disk << 20) => {}
            Size::Bytes(_) => {
                return Some(format!(
                    "The simulation has written more than {disk} MiB, the limit of this server (limits.disk)"
                ));
            }
            Size::Unknown => {
                return Some("The simulation has folders that nobody can look into, too deep or closed".to_owned());
            }
        }
        if count_threads(self.root) > processes {
            return Some(format!(
                "The simulation has more than {processes} processes and threads, the limit of this server (limits.processes)"
            ));
        }
        let taken = process_tree::listening_ports(self.root, &self.ports);
        let taken: Vec<String> = taken.iter().map(u16::to_string).collect();
        (taken.len() > 1)
            .then(|| format!("The simulation listens on the ports {}, of which only one is its own", taken.join(", ")))
    }
}

/// How many bytes of the disk a folder takes; nothing where nobody can tell, since folders in it are closed or too deep.
#[must_use]
pub fn folder_size(folder: &Path) -> Option<u64> {
    match size_of(folder) {
        Size::Bytes(bytes) => Some(bytes),
        Size::Unknown => None,
    }
}

/// What a folder takes of the disk. Links are not followed.
fn size_of(folder: &Path) -> Size {
    let mut total = 0;
    let mut open = vec![folder.to_owned()];
    while let Some(folder) = open.pop() {
        let entries = match std::fs::read_dir(&folder) {
            Ok(entries) => entries,
            // It was removed meanwhile.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
            Err(_) => return Size::Unknown,
        };
        for entry in entries.flatten() {
            total += room_of(&entry);
            if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                open.push(entry.path());
            }
        }
    }
    Size::Bytes(total)
}

/// What a file or folder takes by itself. Holes take nothing.
fn room_of(entry: &DirEntry) -> u64 {
    entry.metadata().map_or(SMALLEST, |about| (about.blocks() * 512).max(SMALLEST))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_folder_takes_is_counted_by_blocks() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a"), vec![1; 100_000]).unwrap();
        std::fs::create_dir(folder.path().join("b")).unwrap();
        std::fs::write(folder.path().join("b/empty"), "").unwrap();
        std::fs::File::create(folder.path().join("hole")).unwrap().set_len(1 << 40).unwrap();
        std::os::unix::fs::symlink("/", folder.path().join("link")).unwrap();
        let Size::Bytes(bytes) = size_of(folder.path()) else { panic!("it is not deep") };
        assert!((100_000 + 4 * SMALLEST..200_000).contains(&bytes), "{bytes}");
    }

    #[test]
    fn folders_that_can_not_be_named_are_told() {
        let folder = tempfile::tempdir().unwrap();
        let mut deepest = std::fs::File::open(folder.path()).unwrap();
        for _ in 0..3000 {
            nix::sys::stat::mkdirat(&deepest, "nested", nix::sys::stat::Mode::S_IRWXU).unwrap();
            let flags = nix::fcntl::OFlag::O_DIRECTORY;
            deepest = nix::fcntl::openat(&deepest, "nested", flags, nix::sys::stat::Mode::empty()).unwrap().into();
        }
        assert_eq!(size_of(folder.path()), Size::Unknown);
        crate::simulation::process::remove_tree(folder.path()).unwrap();
        std::fs::create_dir(folder.path()).unwrap();
    }
}
