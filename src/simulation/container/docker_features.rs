//! The features of this machine's Docker for containers.

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::docker::{Docker, DockerError, SHORT_TIMEOUT};

/// The features of this machine's Docker.
#[derive(Debug, Clone, Default)]
pub struct DockerFeatures {
    /// Whether there are NVIDIA GPUs, and their container runtime.
    pub nvidia: bool,
    /// The groups of the devices of other GPUs; `None` if there are no such GPUs.
    pub graphics: Option<Vec<u32>>,
}

/// The directory of the devices of other GPUs.
const DRI: &str = "/dev/dri";
/// A device of NVIDIA's driver.
const NVIDIA: &str = "/dev/nvidiactl";

impl DockerFeatures {
    /// Queries Docker.
    ///
    /// # Errors
    /// When Docker fails.
    pub async fn query(docker: &Docker) -> Result<Self, DockerError> {
        let format = "{{range $name, $_ := .Runtimes}}{{$name}} {{end}}";
        let runtimes = docker.run(&["info", "--format", format], SHORT_TIMEOUT).await?;
        let nvidia = runtimes.split_whitespace().any(|name| name == "nvidia") && Path::new(NVIDIA).exists();
        Ok(Self { nvidia, graphics: graphics() })
    }
}

fn graphics() -> Option<Vec<u32>> {
    let mut groups: Vec<u32> =
        std::fs::read_dir(DRI).ok()?.flatten().filter_map(|file| Some(file.metadata().ok()?.gid())).collect();
    groups.sort_unstable();
    groups.dedup();
    Some(groups)
}
