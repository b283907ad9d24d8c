//! Git LFS: large files that a repository only points to.

use std::path::{Path, PathBuf};

use which::which;

use super::disk;
use super::mirrors::Remote;

/// A file of a checkout that stands for a larger one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pointer {
    /// Where it is.
    pub path: PathBuf,
    /// How large the file is that it stands for, in bytes.
    pub size: u64,
}

/// How a pointer begins.
const BEGINNING: &str = "version https://git-lfs.github.com/spec/";
/// No pointer is larger, in bytes.
const LARGEST: u64 = 1024;

/// The pointers below a folder. Reads from disk: not for a thread that serves others.
#[must_use]
pub fn pointers(folder: &Path) -> Vec<Pointer> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            match entry.metadata() {
                Ok(about) if about.is_dir() => open.push(entry.path()),
                Ok(about) if about.is_file() && about.len() < LARGEST => {
                    let text = std::fs::read(entry.path()).unwrap_or_default();
                    found.extend(size(&text).map(|size| Pointer { path: entry.path(), size }));
                }
                _ => {}
            }
        }
    }
    found
}

fn size(text: &[u8]) -> Option<u64> {
    let text = std::str::from_utf8(text).ok().filter(|text| text.starts_with(BEGINNING))?;
    text.lines().find_map(|line| line.strip_prefix("size ")).and_then(|size| size.trim().parse().ok())
}

/// Whether git finds its part for LFS. Looks on disk: not for a thread that serves others.
#[must_use]
pub fn is_installed() -> bool {
    which("git-lfs").is_ok()
}

/// Settings with which a checkout loads large files from where the repository is, whatever the repository says.
#[must_use]
pub fn settings(remote: &Remote) -> Vec<String> {
    let location = &remote.location;
    let url = match remote.protocol {
        "file" => format!("file://{location}"),
        _ => format!("{}.git/info/lfs", location.trim_end_matches('/').trim_end_matches(".git")),
    };
    vec![
        format!("lfs.url={url}"),
        // For a folder, git-lfs looks here.
        format!("remote.origin.url={url}"),
        "filter.lfs.process=git-lfs filter-process".to_owned(),
        "filter.lfs.smudge=git-lfs smudge -- %f".to_owned(),
        "filter.lfs.clean=git-lfs clean -- %f".to_owned(),
        "filter.lfs.required=false".to_owned(),
        // A file that can't be had stays a pointer, and is told.
        "lfs.skipdownloaderrors=true".to_owned(),
        "lfs.locksverify=false".to_owned(),
    ]
}

/// Waits until large files take more than `size`, in bytes: a forge may send more than the pointers say. git-lfs keeps what
/// it loads in the folder `cached`, into which others may load meanwhile, and copies it into the project.
pub async fn outgrown(project: &Path, cached: &Path, size: u64) {
    let counted = cached.to_owned();
    let before = actix_rt::task::spawn_blocking(move || disk::size_of(&counted)).await.unwrap_or_default();
    tokio::select! {
        () = disk::outgrown(project, size) => {}
        () = disk::outgrown(cached, before.saturating_add(size.saturating_mul(2))) => {}
    }
}

/// What a client is told of pointers that are left.
#[must_use]
pub fn warning(count: usize, is_installed: bool) -> String {
    let why = if is_installed { "could not be loaded" } else { "can't be loaded: this server has no git-lfs" };
    format!("Warning: {count} files of this project are kept in Git LFS and {why}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pointers_are_told_from_other_files() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &[u8]| std::fs::write(folder.path().join(name), text).unwrap();
        write("mesh.dae", b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1234\n");
        write("small.txt", b"size 5\n");
        write("binary", b"\xff\xfeversion https://git-lfs.github.com/spec/v1\nsize 5\n");
        assert_eq!(pointers(folder.path()), [Pointer { path: folder.path().join("mesh.dae"), size: 1234 }]);
    }

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
