//! Git LFS: large files of which a repository contains only pointers.

use super::repository::REMOTE;
use crate::simulation::config::Remote;

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
        // A file that can't be loaded stays a pointer.
        "lfs.skipdownloaderrors=true".to_owned(),
    ]
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
