//! The access that containers can have to the GPUs of this machine.

use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use which::which;

/// The access to the GPUs of this machine.
#[derive(Debug)]
pub struct GpuAccess {
    /// Whether Docker can give out NVIDIA GPUs.
    pub nvidia: bool,
    /// The groups of the devices of other GPUs; `None` if there are no such GPUs.
    pub groups: Option<BTreeSet<u32>>,
}

/// The program by which Docker gives out NVIDIA GPUs: part of NVIDIA's container toolkit.
const NVIDIA_HOOK: &str = "nvidia-container-runtime-hook";
/// A device of NVIDIA's driver.
const NVIDIA: &str = "/dev/nvidiactl";
/// The directory of the devices of other GPUs.
const DRI: &str = "/dev/dri";

impl GpuAccess {
    /// Looks for the GPUs.
    #[must_use]
    pub fn find() -> Self {
        let group = |file: std::fs::DirEntry| Some(file.metadata().ok()?.gid());
        let groups = std::fs::read_dir(DRI).ok().map(|files| files.flatten().filter_map(group).collect());
        let nvidia = Path::new(NVIDIA).exists() && which(NVIDIA_HOOK).is_ok();
        Self { nvidia, groups }
    }
}
