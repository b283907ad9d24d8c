//! Copies a directory of an image onto the machine, where containers can change it: the image's build may have created
//! files in it.

use std::path::Path;
use std::time::Duration;

use actix_rt::task::spawn_blocking;

use super::docker::{Docker, DockerError, SHORT_TIMEOUT};
use super::owned_resources::REMOVE;
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
    docker.run(&[&REMOVE[..], &[&name]].concat(), SHORT_TIMEOUT).await?;
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
        error => blame(true, error),
    }
}
