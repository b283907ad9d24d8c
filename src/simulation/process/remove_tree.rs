//! Removes a folder with everything inside, however deep it is.
//!
//! `std::fs::remove_dir_all` goes down by recursion, with an open file for each level: a tree of 20,000 levels, which a
//! world's program can make, would overflow the stack of the server. Here each nested folder that is not empty is first
//! moved up into the outermost one. So no tree has more than two levels, and two folders are open at most. Symbolic
//! links are not followed.

use std::ffi::{CStr, CString};
use std::os::fd::AsFd;
use std::path::Path;
use std::time::{Duration, Instant};

use nix::NixPath;
use nix::dir::Dir;
use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, OFlag, renameat};
use nix::sys::stat::{FchmodatFlags, Mode, fchmodat};
use nix::unistd::{UnlinkatFlags, unlinkat};

/// How many names of a folder are held in memory.
const BATCH: usize = 1024;
/// How long it may take: a program that still runs may add files for ever.
const LIMIT: Duration = Duration::from_mins(10);

/// Removes a folder. One that is not there is no error.
///
/// # Errors
/// When something in it can't be removed, or after ten minutes.
pub fn remove_tree(folder: &Path) -> std::io::Result<()> {
    let deadline = Instant::now() + LIMIT;
    let mut root = match open(AT_FDCWD, folder) {
        Err(Errno::ENOENT) => return Ok(()),
        other => other?,
    };
    loop {
        let names = names(&mut root)?;
        if names.is_empty() {
            return std::fs::remove_dir(folder);
        }
        for name in names {
            if !is_removed(&root, &name)? {
                empty(&mut open(&root, name.as_c_str())?, &root)?;
                absent_is_fine(unlinkat(&root, name.as_c_str(), UnlinkatFlags::RemoveDir))?;
            }
            if Instant::now() >= deadline {
                return Err(std::io::ErrorKind::TimedOut.into());
            }
        }
    }
}

/// Removes everything in a folder, except that nested folders with something inside are moved to `root`.
fn empty(folder: &mut Dir, root: &Dir) -> nix::Result<()> {
    loop {
        let names = names(folder)?;
        if names.is_empty() {
            return Ok(());
        }
        for name in names {
            if !is_removed(folder, &name)? {
                let moved = format!(".moved-{:016x}", rand::random::<u64>());
                // A folder can be moved only by those who may write in it.
                make_accessible(&*folder, name.as_c_str());
                absent_is_fine(renameat(&*folder, name.as_c_str(), root, moved.as_str()))?;
            }
        }
    }
}

/// Removes a file, a link or an empty folder. Returns false for a folder with something inside.
fn is_removed(folder: &Dir, name: &CStr) -> nix::Result<bool> {
    let removed = match unlinkat(folder, name, UnlinkatFlags::NoRemoveDir) {
        Err(Errno::EISDIR) => unlinkat(folder, name, UnlinkatFlags::RemoveDir),
        other => other,
    };
    match removed {
        Err(Errno::ENOTEMPTY | Errno::EEXIST) => Ok(false),
        other => absent_is_fine(other).map(|()| true),
    }
}

/// Up to [`BATCH`] names in a folder.
fn names(folder: &mut Dir) -> nix::Result<Vec<CString>> {
    let all = folder.iter().map(|entry| entry.map(|entry| entry.file_name().to_owned()));
    let is_own =
        |name: &nix::Result<CString>| !name.as_ref().is_ok_and(|name| [c".", c".."].contains(&name.as_c_str()));
    all.filter(is_own).take(BATCH).collect()
}

/// Opens a folder, and lets this user change it: a program may have taken that right from its own folders.
fn open<P: NixPath + ?Sized>(parent: impl AsFd, name: &P) -> nix::Result<Dir> {
    make_accessible(parent.as_fd(), name);
    Dir::openat(
        parent,
        name,
        OFlag::O_RDONLY | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC,
        Mode::empty(),
    )
}

fn make_accessible<P: NixPath + ?Sized>(parent: impl AsFd, name: &P) {
    // Where it can't be done, the next step fails and tells why.
    fchmodat(parent, name, Mode::S_IRWXU, FchmodatFlags::NoFollowSymlink).ok();
}

fn absent_is_fine(result: nix::Result<()>) -> nix::Result<()> {
    match result {
        Err(Errno::ENOENT) => Ok(()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// A chain of nested folders with a file in each tenth.
    fn nest(folder: &Path, levels: usize) {
        std::fs::create_dir(folder).unwrap();
        let mut deepest = open(AT_FDCWD, folder).unwrap();
        for level in 0..levels {
            nix::sys::stat::mkdirat(&deepest, "nested", Mode::S_IRWXU).unwrap();
            deepest = open(&deepest, "nested").unwrap();
            if level.is_multiple_of(10) {
                nix::fcntl::openat(&deepest, "file", OFlag::O_CREAT | OFlag::O_WRONLY, Mode::S_IRWXU).unwrap();
            }
        }
    }

    #[test]
    fn a_deep_tree_needs_neither_stack_nor_open_files() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("deep");
        nest(&folder, 3000);
        std::thread::scope(|scope| {
            let small = std::thread::Builder::new().stack_size(64 * 1024);
            small.spawn_scoped(scope, || remove_tree(&folder).unwrap()).unwrap();
        });
        assert!(!folder.exists());
        remove_tree(&folder).unwrap();
    }

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
        std::os::unix::fs::symlink(&other, &folder).unwrap();
        assert!(remove_tree(&folder).is_err());
        assert!(other.join("kept").exists());
    }

    #[test]
    fn wide_and_locked_folders_are_removed() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("folder");
        let locked = folder.join("a/b/c");
        std::fs::create_dir_all(&locked).unwrap();
        for number in 0..BATCH * 2 {
            std::fs::write(locked.join(number.to_string()), "").unwrap();
        }
        std::fs::set_permissions(&locked, std::fs::Permissions::from_mode(0o000)).unwrap();
        std::fs::set_permissions(folder.join("a"), std::fs::Permissions::from_mode(0o500)).unwrap();
        remove_tree(&folder).unwrap();
        assert!(!folder.exists());
    }
}
