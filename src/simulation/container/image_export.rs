//! Copies a directory of an image onto the machine, where containers can change it: the image's build may have created
//! files in it.

use std::path::Path;
use std::time::Duration;

use actix_rt::task::spawn_blocking;

use super::docker::{Docker, DockerError, SHORT_TIMEOUT};
use super::owned_resources;
use super::start_error::{StartError, blame};
use crate::simulation::checkout::{Project, outgrown};
use crate::simulation::process::remove_tree;

/// Timeout of the copy.
const COPY_TIMEOUT: Duration = Duration::from_mins(2);

/// Copies a directory of an image to `to`, which it creates or replaces, by a temporary directory of the project's
/// instance. `name` is the compose project, which its container is named after; `size` the limit, in MiB.
///
/// # Errors
/// Why not, as text for the client.
pub async fn export(
    docker: &Docker,
    name: &str,
    (image, from): (&str, &Path),
    project: &Project,
    to: &Path,
    size: u64,
) -> Result<(), StartError> {
    let name = format!("{name}-{:08x}", rand::random::<u32>());
    let create = ["create", "--name", &name, "--network", "none", image, "true"];
    docker.run(&create, SHORT_TIMEOUT).await.map_err(|error| blame(true, error))?;
    let through = project.instance.path().join("copied");
    let source = format!("{name}:{}/.", from.display());
    let words = ["cp", &source, &through.to_string_lossy()].map(str::to_owned);
    tokio::select! {
        copied = docker.run(&words, COPY_TIMEOUT) => drop(copied.map_err(|error| not_copied(error, from))?),
        () = outgrown(vec![(through.clone(), size << 20)]) => {
            return Err(format!("The project in its image is larger than {size} MiB (projectSize)").into());
        }
    }
    owned_resources::remove(docker, &[name]).await?;
    let to = to.to_owned();
    Ok(spawn_blocking(move || remove_tree(&to).and_then(|()| std::fs::rename(&through, &to))).await??)
}

fn not_copied(error: DockerError, from: &Path) -> StartError {
    let from = from.display();
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
        error => blame(true, error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_that_leads_out_of_the_project_is_told_without_the_folders_of_the_machine() {
        let message = "invalid symlink \"/var/cache/x/copied/link\" -> \"../../outside\"".to_owned();
        let told = not_copied(
            DockerError::Failed { command: "docker cp".to_owned(), message },
            Path::new("/usr/local/webots-project"),
        );
        let told = told.to_string();
        let device = "operation not permitted".to_owned();
        let told_device =
            not_copied(DockerError::Failed { command: "docker cp".to_owned(), message: device }, Path::new("/x"));
        assert!(matches!(told_device, StartError::Project(_)), "{told_device:?}");
        assert!(told.contains("a link to \"../../outside\"") && !told.contains("/var/cache"), "{told}");
    }
}
