//! Git LFS: large files of which a repository contains only pointers.

use std::path::Path;

use super::repository::REMOTE;
use crate::simulation::config::Remote;

/// The first bytes of a pointer.
const BEGINNING: &[u8] = b"version https://git-lfs.github.com/spec/";
/// Size limit of a pointer, in bytes.
const MAX_SIZE: u64 = 1024;

/// How many pointers there are below a folder. Reads from disk: not for a thread that serves others.
pub fn pointers(folder: &Path) -> usize {
    let is_pointer = |path: &Path| std::fs::read(path).is_ok_and(|text| text.starts_with(BEGINNING));
    let (mut found, mut open) = (0, vec![folder.to_owned()]);
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            match entry.metadata() {
                Ok(about) if about.is_dir() => open.push(entry.path()),
                Ok(about) if about.is_file() && about.len() < MAX_SIZE => {
                    found += usize::from(is_pointer(&entry.path()));
                }
                _ => {}
            }
        }
    }
    found
}

/// Settings with which a checkout loads large files from where the repository is, whatever the repository says.
pub fn settings(remote: &Remote) -> Vec<String> {
    let location = &remote.location;
    let url = match remote.protocol {
        "file" => format!("file://{location}"),
        _ => format!("{}.git/info/lfs", location.trim_end_matches('/').trim_end_matches(".git")),
    };
    vec![
        format!("lfs.url={url}"),
        // For a local directory, git-lfs reads this.
        format!("remote.{REMOTE}.url={url}"),
        "filter.lfs.process=git-lfs filter-process".to_owned(),
        "filter.lfs.smudge=git-lfs smudge -- %f".to_owned(),
        "filter.lfs.clean=git-lfs clean -- %f".to_owned(),
        "filter.lfs.required=false".to_owned(),
        // A file that can't be loaded stays a pointer, and is reported.
        "lfs.skipdownloaderrors=true".to_owned(),
    ]
}

/// The warning for a client about pointers that are left.
pub fn warning(count: usize, is_installed: bool) -> String {
    let why = if is_installed { "could not be loaded" } else { "can't be loaded: this server has no git-lfs" };
    format!("Warning: {count} files of this project are kept in Git LFS and {why}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_files_come_from_where_the_repository_is() {
        let first = |location: &str, protocol| {
            let location = location.to_owned();
            settings(&Remote { location, protocol })[0].clone()
        };
        assert_eq!(first("https://github.com/l/a.git", "https"), "lfs.url=https://github.com/l/a.git/info/lfs");
        assert_eq!(first("https://forge.org/l/a", "https"), "lfs.url=https://forge.org/l/a.git/info/lfs");
        assert_eq!(first("/mirror/l/a", "file"), "lfs.url=file:///mirror/l/a");
    }
}
