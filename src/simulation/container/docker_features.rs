//! What this machine's Docker offers to containers.

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::docker::{Docker, DockerError, SHORT};

/// What this machine's Docker offers.
#[derive(Debug, Clone, Default)]
pub struct DockerFeatures {
    /// Graphics cards of NVIDIA, with the runtime for containers.
    pub nvidia: bool,
    /// The groups that may use other graphics cards, where there are some.
    pub graphics: Option<Vec<u32>>,
}

/// Other graphics cards.
const DRI: &str = "/dev/dri";
/// One of NVIDIA.
const NVIDIA: &str = "/dev/nvidiactl";

impl DockerFeatures {
    /// Asks Docker.
    ///
    /// # Errors
    /// When Docker fails.
    pub async fn ask(docker: &Docker) -> Result<Self, DockerError> {
        let format = "{{range $name, $_ := .Runtimes}}{{$name}} {{end}}";
        let told = docker.run(&["info", "--format", format], SHORT).await?;
        // The newest line is the answer; warnings come before it.
        let answer = told.lines().last().unwrap_or_default();
        let nvidia = answer.split_whitespace().any(|name| name == "nvidia") && Path::new(NVIDIA).exists();
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
