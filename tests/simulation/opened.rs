//! Shared by the tests of checkouts: a Webots that prints what it opens, and what is on the disk.

use std::path::{Path, PathBuf};

use crate::support::{Server, Webots};

/// A Webots that prints the second line and the path of its world, and fails: the error for its client has both.
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
            if entry.path().is_dir() {
                size_of(&entry.path())
            } else {
                entry.metadata().map_or(0, |about| about.len())
            }
        })
        .sum()
}

pub fn cached(server: &Server) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(server.folder.join("cache/git"))
        .unwrap()
        .flatten()
        .map(|entry| entry.path());
    entries.filter(|path| path.is_dir()).collect()
}
