//! Removes unused images of this server.

use super::docker::{DockerError, SHORT};
use super::dockerfile::LABEL;
use super::image::Images;

impl Images {
    /// Removes the images that this server has built more than so many hours ago and that no container uses, and what builds
    /// that failed have left. Docker keeps the base images: it knows ours by their label.
    ///
    /// # Errors
    /// When Docker fails.
    pub async fn prune(&self, hours: u64) -> Result<(), DockerError> {
        let (mine, old) = (format!("label={LABEL}={}", self.owner.name()), format!("until={hours}h"));
        let prune = ["image", "prune", "--force", "--filter", &mine, "--filter"];
        // The images of a build in progress are younger.
        for rest in [&["until=1h"][..], &[&old, "--all"]] {
            self.docker.run(&[&prune, rest].concat(), SHORT).await?;
        }
        Ok(())
    }
}
