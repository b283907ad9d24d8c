//! What the tests of checkouts share: a Webots that tells what it was given, and what is left on the disk.

use std::path::{Path, PathBuf};

use crate::support::{Server, Webots};

/// A Webots that tells which world it was given, and ends: its client hears the world's second line.
pub fn reader() -> Webots {
    Webots::script("for last; do :; done\necho \"opened [$(sed -n 2p \"$last\")] $last\"\nexit 1")
}

pub fn world_text(mark: &str) -> String {
    format!("#VRML_SIM R2025a utf8\n{mark}\n")
}

pub fn size_of(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .map(|entry| {
            if entry.path().is_dir() { size_of(&entry.path()) } else { entry.metadata().map_or(0, |about| about.len()) }
        })
        .sum()
}

pub fn cached(server: &Server) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(server.folder.join("cache/git")).unwrap().flatten().map(|entry| entry.path());
    entries.filter(|path| path.is_dir()).collect()
}
