//! The images of simulations: pulled, and built once for all clients of the same project.

use std::ffi::OsString;
use std::path::Path;
use std::sync::Arc;

use actix_rt::task::spawn_blocking;
use tokio::sync::{Semaphore, SemaphorePermit, watch};

use super::build_plan::{self, ImageBuild};
use super::built_image::BuiltImage;
use super::compose_project::DEFAULT_MEMORY;
use super::docker::{Docker, DockerError, SHORT_TIMEOUT};
use super::dockerfile::LABEL;
use super::owned_resources::{ResourceOwner, digest};
use super::start_error::{StartError, blame, is_disk_full};
use super::steps;
use crate::simulation::checkout::{OnProgress, Project, SingleFlight};
use crate::simulation::config::SimulationConfig;

/// The images of this server.
pub struct Images {
    docker: Docker,
    owner: ResourceOwner,
    config: Arc<SimulationConfig>,
    /// Limits concurrent builds.
    builds: Semaphore,
    jobs: SingleFlight<String, Result<(), StartError>>,
}

/// How a Dockerfile names the image of the world's version of Webots.
const DEFAULT_BASE: [&str; 2] = ["$WEBOTS_DEFAULT_IMAGE", "${WEBOTS_DEFAULT_IMAGE}"];
/// Formats of what is asked of an image: its id, which differs from those of later images of the same name, and the
/// configuration of its programs.
const ID: &str = "{{.Id}}";
const CONFIG: &str = "{{json .Config}}";

impl Images {
    /// The images of this owner.
    pub fn new(docker: Docker, owner: ResourceOwner, config: Arc<SimulationConfig>) -> Self {
        let builds = Semaphore::new(config.container.builds);
        Self { docker, owner, config, builds, jobs: SingleFlight::default() }
    }

    /// Pulls a configured image unless it exists. Returns its id, which differs from those of later images of the same
    /// name.
    ///
    /// # Errors
    /// Why it can't be pulled, as text for the client.
    pub async fn pull(self: &Arc<Self>, image: &str, progress: OnProgress<'_>) -> Result<String, StartError> {
        let (this, name) = (Arc::clone(self), image.to_owned());
        let pull = move |sender: watch::Sender<String>| async move {
            let _permit = this.permit(&sender).await?;
            let on_line = |line: &str| drop(sender.send(steps::pulling(&name, line)));
            let command = ["docker", "pull", &name].map(OsString::from).to_vec();
            let pulled = this.docker.follow(command, Vec::new(), this.config.timing.build, on_line).await;
            pulled.map_err(|error| not_pulled(&name, error))
        };
        self.made(image, ID, false, progress, pull).await
    }

    /// Builds an image of a project unless it exists.
    ///
    /// # Errors
    /// Why it can't be built or used, as text for the client.
    pub async fn build(
        self: &Arc<Self>,
        project: &Arc<Project>,
        mut build: ImageBuild,
        progress: OnProgress<'_>,
    ) -> Result<BuiltImage, StartError> {
        let webots = build_plan::image_of(&self.config.container.image, &project.world.version);
        build.arguments.push(format!("WEBOTS_DEFAULT_IMAGE={webots}"));
        let mut parts = [vec![build.dockerfile.text.clone()], build.arguments.clone()].concat();
        parts.extend(build.folder.into_iter().flat_map(|folder| [project.identity(), folder.to_owned()]));
        // An image's name stays the same when the image is updated, so its id is part of the key. A base that is not here
        // yet has none: the build fetches it.
        for base in &build.dockerfile.bases {
            let is_default = DEFAULT_BASE.contains(&base.as_str());
            parts.extend(if is_default {
                Some(self.pull(&webots, progress).await?)
            } else {
                self.inspect(base, ID).await?
            });
        }
        let name = format!("webots-fleet/{}:{}", self.owner.0, digest(parts.join("\0").as_bytes()));
        let is_projects = build.folder.is_some();
        let (this, project, tag) = (Arc::clone(self), Arc::clone(project), name.clone());
        let job = |sender| async move { this.build_now(&tag, &project, build, sender).await };
        let config = self.made(&name, CONFIG, is_projects, progress, job).await?;
        Ok(BuiltImage::read(name, &config)?)
    }

    /// Makes an image by this job unless it exists. Returns what Docker says of it in this format. What a project's own
    /// Dockerfile makes may have settings that are too large to be read.
    async fn made<F: Future<Output = Result<(), StartError>> + Send + 'static>(
        &self,
        name: &str,
        format: &str,
        is_projects: bool,
        progress: OnProgress<'_>,
        job: impl FnOnce(watch::Sender<String>) -> F,
    ) -> Result<String, StartError> {
        if let Some(found) = self.inspect(name, format).await? {
            return Ok(found);
        }
        self.jobs.join(name.to_owned(), progress, job).await?;
        let inspect = ["image", "inspect", "--format", format, name];
        let found = self.docker.run(&inspect, SHORT_TIMEOUT).await.map_err(|error| blame(is_projects, error))?;
        Ok(found.trim().to_owned())
    }

    async fn build_now(
        &self,
        name: &str,
        project: &Project,
        build: ImageBuild,
        sender: watch::Sender<String>,
    ) -> Result<(), StartError> {
        // What has no step of a project takes seconds.
        let _permit = if build.folder.is_some() { Some(self.permit(&sender).await?) } else { None };
        let ImageBuild { dockerfile, folder, arguments } = build;
        let (instance, root) = (project.instance.path().to_owned(), project.folder.clone());
        let prepare = move || {
            let file = instance.join(format!("Dockerfile{}", folder.unwrap_or_default()));
            std::fs::write(&file, dockerfile.text)?;
            let empty = instance.join("empty");
            std::fs::create_dir_all(&empty)?;
            // A copy out of an image may have replaced it by a symlink to any path.
            let context = folder.map_or(Ok(empty), |folder| build_plan::inside(&root, Path::new(folder)))?;
            Ok::<_, StartError>((file, context))
        };
        let (file, context) = spawn_blocking(prepare).await??;
        let memory = format!("{}m", self.config.limits.memory.unwrap_or(DEFAULT_MEMORY));
        let network = self.config.container.network.name();
        let limited = ["docker", "build", "--force-rm", "--memory", &memory, "--memory-swap", &memory];
        let options = ["--network", network, "--tag", name, "--file"];
        let words = limited.into_iter().chain(options).map(OsString::from).chain([file.into()]);
        let arguments = arguments.into_iter().flat_map(|argument| ["--build-arg".into(), argument.into()]);
        let words = words.chain(arguments).chain([context.into()]);
        let mut step = String::new();
        let on_line = |line: &str| {
            if line.starts_with("Step ") {
                line.clone_into(&mut step);
            }
            if let Some(text) = steps::building(line) {
                sender.send(text).ok();
            }
        };
        let done = self.docker.follow(words.collect(), Vec::new(), self.config.timing.build, on_line).await;
        done.map_err(|error| not_built(&step, error))
    }

    async fn permit(&self, sender: &watch::Sender<String>) -> Result<SemaphorePermit<'_>, StartError> {
        if let Ok(permit) = self.builds.try_acquire() {
            return Ok(permit);
        }
        sender.send("waiting for images of others to be built".to_owned()).ok();
        let limit = self.config.timing.build;
        let busy = || format!("Images of others were being built for {} seconds (timing.build)", limit.as_secs());
        let permit = actix_rt::time::timeout(limit, self.builds.acquire()).await.ok().and_then(Result::ok);
        permit.ok_or_else(|| StartError::Server(busy()))
    }

    /// What Docker says of an image in this format; `None` if it does not exist.
    async fn inspect(&self, image: &str, format: &str) -> Result<Option<String>, StartError> {
        match self.docker.run(&["image", "inspect", "--format", format, image], SHORT_TIMEOUT).await {
            Ok(found) => Ok(Some(found.trim().to_owned())),
            Err(DockerError::Failed { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes the images that this server has built more than so many hours ago and that no container uses, and what builds
    /// that failed have left. Docker keeps the base images: it knows ours by their label.
    ///
    /// # Errors
    /// When Docker fails.
    pub async fn prune(&self, hours: u64) -> Result<(), DockerError> {
        let (mine, old) = (format!("label={LABEL}={}", self.owner.0), format!("until={hours}h"));
        let prune = ["image", "prune", "--all", "--force", "--filter", &mine, "--filter", &old];
        self.docker.run(&prune, SHORT_TIMEOUT).await.map(drop)
    }
}

/// Why a configured image can't be pulled, as text for the client.
fn not_pulled(image: &str, error: DockerError) -> StartError {
    let is_own = matches!(error, DockerError::Slow { .. }) || is_silent(&error.to_string());
    match not_made(Some(image), |message| format!("The image {image} can't be fetched: {message}"), error) {
        StartError::Project(why) if is_own => StartError::Server(why),
        error => error,
    }
}

/// Why an image was not built in this step, as text for the client. Only a `FROM` step can fail because of a missing image.
fn not_built(step: &str, error: DockerError) -> StartError {
    let base = step.split_once(" : FROM ").and_then(|(_, image)| image.split(' ').next());
    not_made(base, |message| format!("The image of this project can't be built: {message} ({step})"), error)
}

/// Why an image with this base was not made, as text for the client.
fn not_made(base: Option<&str>, tell: impl Fn(&str) -> String, error: DockerError) -> StartError {
    match (base, error) {
        (Some(image), DockerError::Failed { message, .. }) if is_unknown(&message) => no_image(image),
        (_, DockerError::Failed { message, .. }) if is_disk_full(&message) => StartError::Server(tell(&message)),
        (_, DockerError::Failed { message, .. }) => StartError::Project(tell(&message)),
        (_, DockerError::Slow { limit, .. }) => {
            StartError::Project(format!("Its image was not ready within {} seconds (timing.build)", limit.as_secs()))
        }
        (_, error) => error.into(),
    }
}

fn no_image(image: &str) -> StartError {
    StartError::Project(format!(
        "There is no image {image} for this version of Webots where this simulation server looks for images. Another \
         version of the world, or a Dockerfile in its project that begins with an image that there is, helps"
    ))
}

/// Whether a registry reports that there is no such image.
fn is_unknown(message: &str) -> bool {
    ["not found", "pull access denied", "manifest unknown", "repository does not exist"]
        .iter()
        .any(|words| message.contains(words))
}

/// Whether a registry does not answer, or not now. Image names contain no spaces.
fn is_silent(message: &str) -> bool {
    let message = message.to_lowercase();
    let words = ["toomanyrequests: ", "i/o timeout", "handshake timeout", "timeout exceeded", "deadline exceeded"];
    words.iter().any(|words| message.contains(words))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failed(message: &str) -> DockerError {
        DockerError::Failed { command: "docker build".to_owned(), message: message.to_owned() }
    }

    #[test]
    fn an_image_that_is_not_there_is_told_in_words_and_only_where_a_stage_begins() {
        let told =
            not_built("Step 1/4 : FROM cyberbotics/webots.cloud:R1-ubuntu22.04 AS a", failed("manifest unknown"));
        let told = told.to_string();
        assert!(
            told.starts_with("There is no image cyberbotics/webots.cloud:R1-ubuntu22.04 for this version"),
            "{told}"
        );
        let told = not_built("Step 2/4 : RUN make", failed("make: not found"));
        let words = "The image of this project can't be built: make: not found (Step 2/4 : RUN make)";
        assert_eq!(told, StartError::Project(words.to_owned()));
        let gone = not_built("Step 2/4 : RUN make", DockerError::Unavailable("refused".to_owned()));
        assert!(matches!(gone, StartError::Server(_)), "{gone:?}");
        let full = not_built("Step 3/4 : COPY . /x", failed("write /x: no space left on device"));
        assert!(matches!(full, StartError::Server(_)), "{full:?}");
    }

    #[test]
    fn a_registry_that_does_not_answer_is_the_fault_of_who_has_named_it() {
        let limited = || failed("toomanyrequests: You have reached your pull rate limit");
        assert!(matches!(not_pulled("a", limited()), StartError::Server(_)));
        assert!(matches!(not_built("Step 1/4 : FROM a", limited()), StartError::Project(_)));
        assert!(matches!(not_pulled("a", failed("invalid reference format")), StartError::Project(_)));
        let full = failed("failed to register layer: write /x: no space left on device");
        assert!(matches!(not_built("Step 1/4 : FROM a", full), StartError::Server(_)));
    }
}
