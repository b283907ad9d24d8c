//! Full and read-only disks, in a mount namespace of this test and the programs that it starts.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use nix::mount::{MntFlags, MsFlags, mount, umount2};
use nix::sched::{CloneFlags, unshare};

/// Later mounts are visible only to this thread and its children, and vanish with them. Without the privileges for
/// that, tests of disk faults are not possible.
pub fn hide_mounts_from_others() {
    if unshare(CloneFlags::CLONE_NEWNS).is_ok() {
        mount(
            None::<&str>,
            "/",
            None::<&str>,
            MsFlags::MS_REC | MsFlags::MS_PRIVATE,
            None::<&str>,
        )
        .unwrap();
    }
}

/// Mounts a disk of this many MiB; returns whether that worked.
pub fn small_disk(folder: &Path, size: u32) -> bool {
    std::fs::create_dir_all(folder).unwrap();
    mount(
        Some("small"),
        folder,
        Some("tmpfs"),
        MsFlags::empty(),
        Some(&*format!("size={size}m")),
    )
    .is_ok()
}

/// A file that fills up a disk.
pub struct Full(PathBuf);

impl Full {
    pub fn at(folder: &Path) -> Self {
        let path = folder.join("filler");
        let mut file = File::create(&path).unwrap();
        for size in [1 << 20, 4096, 1] {
            while file.write_all(&vec![0; size]).is_ok() {}
        }
        Self(path)
    }
}

impl Drop for Full {
    fn drop(&mut self) {
        std::fs::remove_file(&self.0).ok();
    }
}

/// A read-only folder.
pub struct ReadOnly(PathBuf);

impl ReadOnly {
    /// An empty folder, mounted over this one.
    pub fn empty(folder: &Path) -> Option<Self> {
        mount(Some("nothing"), folder, Some("tmpfs"), MsFlags::MS_RDONLY, None::<&str>).ok()?;
        Some(Self(folder.to_owned()))
    }

    /// The folder itself, still readable.
    pub fn at(folder: &Path) -> Option<Self> {
        mount(Some(folder), folder, None::<&str>, MsFlags::MS_BIND, None::<&str>).ok()?;
        let this = Self(folder.to_owned());
        let flags = MsFlags::MS_BIND | MsFlags::MS_REMOUNT | MsFlags::MS_RDONLY;
        mount(None::<&str>, folder, None::<&str>, flags, None::<&str>).ok()?;
        Some(this)
    }
}

impl Drop for ReadOnly {
    fn drop(&mut self) {
        umount2(&self.0, MntFlags::MNT_DETACH).ok();
    }
}
