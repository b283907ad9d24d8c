//! Removes a directory with its contents by the system's `rm`: it handles any depth, which a recursion in the server
//! would not, and does not follow symlinks.

use std::ffi::OsString;
use std::io;
use std::path::Path;
use std::time::Duration;

use super::process_group::ExitReason;
use super::runner::Run;

/// Timeout: a program that still runs may keep adding files.
const LIMIT: Duration = Duration::from_mins(10);

/// Removes a directory. Treats `NotFound` as success. Blocks.
///
/// # Errors
/// When something in it can't be removed, or after ten minutes.
pub fn remove_tree(folder: &Path) -> io::Result<()> {
    if folder.symlink_metadata().is_err_and(|error| error.kind() == io::ErrorKind::NotFound) {
        return Ok(());
    }
    run(&["rm", "-rf", "--"], folder).or_else(|_| {
        // A world's program may have removed the write permission of its directories.
        run(&["chmod", "-R", "u+rwX", "--"], folder).ok();
        run(&["rm", "-rf", "--"], folder)
    })
}

fn run(words: &[&str], folder: &Path) -> io::Result<()> {
    let command = words.iter().map(OsString::from).chain([folder.into()]);
    let mut complaint = String::new();
    // Its mark is not that of a run: ending a run does not kill it.
    let ran = Run::new(command, Path::new("/"), LIMIT).blocking(|line| complaint = line);
    let ran = ran.map_err(|error| io::Error::other(format!("{} {error}", words.join(" "))))?;
    if ran.ending == ExitReason::Code(0) { Ok(()) } else { Err(io::Error::other(complaint)) }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use nix::sys::stat::Mode;

    use super::*;

    #[test]
    fn links_are_removed_and_not_followed() {
        let place = tempfile::tempdir().unwrap();
        let (folder, other) = (place.path().join("folder"), place.path().join("other"));
        std::fs::create_dir_all(folder.join("inside")).unwrap();
        std::fs::create_dir(&other).unwrap();
        std::fs::write(other.join("kept"), "").unwrap();
        std::os::unix::fs::symlink(&other, folder.join("link")).unwrap();
        std::os::unix::fs::symlink(&other, folder.join("inside/link")).unwrap();
        nix::unistd::mkfifo(&folder.join("inside/pipe"), Mode::S_IRWXU).unwrap();
        remove_tree(&folder).unwrap();
        assert!(!folder.exists() && other.join("kept").exists());
    }

    #[test]
    fn locked_folders_are_removed() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("folder");
        std::fs::create_dir_all(folder.join("a/b/c")).unwrap();
        for (locked, mode) in [("a/b/c", 0o000), ("a/b", 0o300), ("a", 0o500)] {
            std::fs::write(folder.join(locked).join("file"), "").unwrap();
            std::fs::set_permissions(folder.join(locked), std::fs::Permissions::from_mode(mode)).unwrap();
        }
        remove_tree(&folder).unwrap();
        assert!(!folder.exists());
    }
}
