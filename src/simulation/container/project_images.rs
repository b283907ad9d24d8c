//! The images of a project: built from its Dockerfiles, and opened for the server's user.

use std::sync::Arc;

use super::blocking::blocking;
use super::build_plan::{self, PROJECT_PATH};
use super::docker::DockerError;
use super::dockerfile;
use super::image::{Build, Images};
use super::opened;
use super::start_error::{StartError, is_disk_full};
use crate::simulation::checkout::Project;

/// An image that is built from a project, or from a directory of it.
#[derive(Debug)]
pub struct Part<'part> {
    /// The project.
    pub project: &'part Arc<Project>,
    /// The image of its version of Webots.
    pub base: &'part str,
    /// The text of the Dockerfile.
    pub text: &'part str,
    /// The directory that it copies from; empty for the whole project.
    pub folder: &'part str,
    /// Whether the project has a Makefile.
    pub make: bool,
    /// The Docker network that it may use.
    pub network: &'static str,
}

impl Images {
    /// Builds an image of a project unless it exists. Returns its name.
    ///
    /// # Errors
    /// Why it can't be built, as text for the client.
    pub async fn of_project(
        self: &Arc<Self>,
        part: Part<'_>,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<String, StartError> {
        let Part { project, base, text, folder, make, network } = part;
        let mut arguments = vec![
            format!("WEBOTS_DEFAULT_IMAGE={base}"),
            format!("PROJECT_PATH={PROJECT_PATH}"),
            format!("MAKE={}", u8::from(make)),
        ];
        if !folder.is_empty() {
            arguments
                .extend(["WEBOTS_CONTROLLER_URL=participant", "DEFAULT_CONTROLLER=participant"].map(str::to_owned));
        }
        // An image's name stays the same when the image is updated, so its id is part of the key.
        let mut bases = Vec::new();
        for image in dockerfile::bases(text, &arguments) {
            bases.push(self.pull(&image, progress).await?);
        }
        let identity = project.identity();
        let parts =
            [identity.as_str(), folder, text].into_iter().chain(arguments.iter().chain(&bases).map(String::as_str));
        let key = opened::key(parts);
        let dockerfile = project.instance.path().join(format!("Dockerfile{folder}"));
        let (file, text) = (dockerfile.clone(), text.to_owned());
        blocking(move || std::fs::write(file, text)).await?;
        let (root, folder) = (project.folder().to_owned(), folder.to_owned());
        // A copy out of an image may have replaced it by a symlink to any path.
        let context = blocking(move || build_plan::inside(&root, &folder)).await?;
        let project = Arc::clone(project);
        self.build(Build { key, dockerfile, context, arguments, network, project }, progress).await
    }

    /// Creates the image in which the server's user can read the home directory of the image's own user.
    ///
    /// # Errors
    /// Why it can't be created, as text for the client.
    pub async fn open_now(&self, image: &str, name: &str, project: &Project) -> Result<(), StartError> {
        let text = self.about(image).await?.dockerfile(self.owner.name());
        let context = project.instance.path().join(format!("opened-{}", opened::key(std::iter::once(name))));
        let (dockerfile, folder) = (context.with_extension("Dockerfile"), context.clone());
        let file = dockerfile.clone();
        let write = move || std::fs::write(file, text).and_then(|()| opened::write_programs(&folder));
        blocking(write).await?;
        let options = ["--network", "none", "--tag", name].map(Into::into).to_vec();
        let done = self.run_build(options, &dockerfile, &context, |_| ()).await;
        done.map_err(|error| match error {
            DockerError::Failed { message, .. } => {
                let kind = if is_disk_full(&message) { StartError::Server } else { StartError::Project };
                kind(format!("The image can't be prepared for this server's user: {message}"))
            }
            error => error.into(),
        })
    }
}
