//! Copies a directory of an image onto the machine, where containers can change it: the image's build may have created
//! files in it.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::blocking::blocking;
use super::docker::{Docker, DockerError, SHORT};
use super::owned_resources;
use super::start_error::StartError;
use crate::simulation::process::{disk_usage, remove_tree};

/// The source and the destination of a copy.
#[derive(Debug)]
pub struct ImageExport<'copy> {
    /// The name of the compose project.
    pub name: &'copy str,
    /// The id or name of the image.
    pub image: &'copy str,
    /// The directory in the image.
    pub from: String,
    /// A temporary directory that does not exist yet.
    pub through: PathBuf,
    /// The directory that is created or replaced.
    pub to: &'copy Path,
    /// Size limit, in MiB.
    pub size: u64,
}

/// Timeout of the copy.
const LIMIT: Duration = Duration::from_mins(2);
/// Interval between two checks of the copied size.
const LOOK: Duration = Duration::from_millis(300);

impl ImageExport<'_> {
    /// Runs the copy.
    ///
    /// # Errors
    /// Why not, as text for the client.
    pub async fn run(self, docker: &Docker) -> Result<(), StartError> {
        let label = format!("{}={}", owned_resources::PROJECT, self.name);
        let create = ["create", "--label", &label, "--network", "none", self.image, "true"];
        let container = docker.run(&create, SHORT).await.map_err(StartError::of_project)?;
        let container = container.lines().last().unwrap_or_default();
        let from = format!("{container}:{}/.", self.from);
        let words = ["cp", &from, &self.through.to_string_lossy()].map(str::to_owned);
        tokio::select! {
            copied = docker.run(&words, LIMIT) => drop(copied.map_err(|error| not_copied(error, &self.from))?),
            () = outgrown(&self.through, self.size << 20) => {
                return Err(format!("The project in its image is larger than {} MiB (projectSize)", self.size).into());
            }
        }
        docker.run(&["rm", "--force", "--volumes", container], SHORT).await?;
        let (through, to) = (self.through, self.to.to_owned());
        let replace = move || remove_tree(&to).and_then(|()| std::fs::rename(&through, &to));
        blocking(replace).await
    }
}

fn not_copied(error: DockerError, from: &str) -> StartError {
    match error {
        DockerError::Failed { message, .. }
            if message.contains("ould not find") || message.contains("o such container:path") =>
        {
            format!("The image of this project has no folder {from}: its Dockerfile has to COPY the project there")
                .into()
        }
        DockerError::Failed { message, .. } if message.contains("invalid symlink") => {
            let target = message.split_once(" -> ").map_or("elsewhere", |(_, target)| target);
            let what = format!("{from} in the image of this project has a link to {target}");
            format!("{what}, which leads out of it: `docker cp` refuses that").into()
        }
        error => StartError::of_project(error),
    }
}

/// Waits until a directory exceeds its size limit, or can't be measured.
async fn outgrown(folder: &Path, most: u64) {
    loop {
        actix_rt::time::sleep(LOOK).await;
        let folder = folder.to_owned();
        let size = actix_rt::task::spawn_blocking(move || disk_usage::room_of(&folder)).await;
        if size.is_ok_and(|size| size.is_none_or(|bytes| bytes > most)) {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_that_leads_out_of_the_project_is_told_without_the_folders_of_the_machine() {
        let message = "invalid symlink \"/var/cache/x/copied/link\" -> \"../../outside\"".to_owned();
        let told =
            not_copied(DockerError::Failed { command: "docker cp".to_owned(), message }, "/usr/local/webots-project");
        let told = told.to_string();
        let device = "operation not permitted".to_owned();
        let told_device = not_copied(DockerError::Failed { command: "docker cp".to_owned(), message: device }, "/x");
        assert!(matches!(told_device, StartError::Project(_)), "{told_device:?}");
        assert!(told.contains("a link to \"../../outside\"") && !told.contains("/var/cache"), "{told}");
    }
}
