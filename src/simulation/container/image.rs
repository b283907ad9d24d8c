//! The images of simulations: pulled, and built once for all clients of the same project.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use tokio::sync::{Semaphore, SemaphorePermit, watch};

use super::build_plan::{self, PROJECT_PATH};
use super::compose_project::DEFAULT_MEMORY;
use super::docker::{Docker, DockerError, SHORT_TIMEOUT};
use super::dockerfile::{Dockerfile, LABEL};
use super::opened::{self, ImageConfig};
use super::owned_resources::ResourceOwner;
use super::start_error::{StartError, blame, is_disk_full};
use super::steps;
use crate::simulation::checkout::{OnProgress, Project, SingleFlight};
use crate::simulation::config::SimulationConfig;

/// The images of this server.
#[derive(Debug)]
pub struct Images {
    docker: Docker,
    owner: ResourceOwner,
    /// Timeout of a pull, and of a build.
    limit: Duration,
    /// Memory limit of a build step, in MiB.
    memory: u64,
    /// Limits concurrent builds.
    builds: Semaphore,
    jobs: SingleFlight<String, Result<(), StartError>>,
}

/// An image to build from a project, or from a directory of it.
#[derive(Debug)]
pub struct ImageBuild {
    /// The project, kept until the build has ended.
    pub project: Arc<Project>,
    /// The image of its version of Webots.
    pub base: String,
    /// The Dockerfile.
    pub dockerfile: Dockerfile,
    /// The directory that it copies from; empty for the whole project.
    pub folder: &'static str,
    /// Whether the project has a Makefile.
    pub has_makefile: bool,
    /// The Docker network that it may use.
    pub network: &'static str,
}

/// How a Dockerfile names the image of the world's version of Webots.
const DEFAULT_BASE: [&str; 2] = ["$WEBOTS_DEFAULT_IMAGE", "${WEBOTS_DEFAULT_IMAGE}"];
/// Arguments of the Dockerfile of a participant's controller.
const PARTICIPANT: [&str; 2] = ["WEBOTS_CONTROLLER_URL=participant", "DEFAULT_CONTROLLER=participant"];

impl Images {
    /// The images of this owner.
    #[must_use]
    pub fn new(docker: Docker, owner: ResourceOwner, config: &SimulationConfig) -> Self {
        let (builds, limit) = (Semaphore::new(config.container.builds), config.timing.build);
        let memory = config.limits.memory.unwrap_or(DEFAULT_MEMORY);
        Self { docker, owner, limit, memory, builds, jobs: SingleFlight::default() }
    }

    /// The name of one of this server's images; unique.
    fn name(&self, parts: &[String]) -> String {
        format!("webots-fleet/{}:{}", self.owner.name(), opened::key(parts))
    }

    /// Pulls a configured image unless it exists. Returns its id, which differs from those of later images of the same
    /// name.
    ///
    /// # Errors
    /// Why it can't be pulled, as text for the client.
    pub async fn pull(self: &Arc<Self>, image: &str, progress: OnProgress<'_>) -> Result<String, StartError> {
        if let Some(id) = self.id(image).await? {
            return Ok(id);
        }
        let (this, name) = (Arc::clone(self), image.to_owned());
        let pull = move |sender: watch::Sender<String>| async move {
            let _permit = this.permit(&sender).await?;
            let on_line = |line: &str| drop(sender.send(steps::pulling(&name, line)));
            let pulled = this.docker.follow(["pull", &name].map(OsString::from).to_vec(), this.limit, on_line).await;
            pulled.map_err(|error| not_pulled(&name, error))
        };
        self.jobs.join(image.to_owned(), progress, pull).await?;
        self.id(image).await?.ok_or_else(|| StartError::Server(format!("The image {image} was removed meanwhile")))
    }

    /// Builds an image of a project unless it exists, opened for the server's user. Returns its name.
    ///
    /// # Errors
    /// Why it can't be built, as text for the client.
    pub async fn build(self: &Arc<Self>, build: ImageBuild, progress: OnProgress<'_>) -> Result<String, StartError> {
        let mut arguments = vec![
            format!("WEBOTS_DEFAULT_IMAGE={}", build.base),
            format!("PROJECT_PATH={PROJECT_PATH}"),
            format!("MAKE={}", u8::from(build.has_makefile)),
        ];
        if !build.folder.is_empty() {
            arguments.extend(PARTICIPANT.map(str::to_owned));
        }
        let mut parts = vec![build.project.identity(), build.folder.to_owned(), build.dockerfile.text.clone()];
        parts.extend_from_slice(&arguments);
        // An image's name stays the same when the image is updated, so its id is part of the key. A base that is not here
        // yet has none: the build fetches it.
        for base in &build.dockerfile.bases {
            let is_default = DEFAULT_BASE.contains(&base.as_str());
            parts.extend(if is_default {
                Some(self.pull(&build.base, progress).await?)
            } else {
                self.id(base).await?
            });
        }
        let name = self.name(&parts);
        let (this, tag) = (Arc::clone(self), name.clone());
        self.once(name, progress, move |sender| async move { this.build_now(&tag, build, arguments, sender).await })
            .await
    }

    async fn build_now(
        &self,
        name: &str,
        build: ImageBuild,
        arguments: Vec<String>,
        sender: watch::Sender<String>,
    ) -> Result<(), StartError> {
        let _permit = self.permit(&sender).await?;
        let ImageBuild { project, dockerfile, folder, network, .. } = build;
        let (file, root) = (project.instance.path().join(format!("Dockerfile{folder}")), project.folder().to_owned());
        let written = file.clone();
        let prepare = move || {
            std::fs::write(written, dockerfile.text)?;
            // A copy out of an image may have replaced it by a symlink to any path.
            Ok::<_, StartError>(build_plan::inside(&root, Path::new(folder))?)
        };
        let context = spawn_blocking(prepare).await??;
        let id_file = file.with_extension("id");
        let mut options: Vec<OsString> =
            vec!["--network".into(), network.into(), "--iidfile".into(), (&id_file).into()];
        options.extend(arguments.into_iter().flat_map(|argument| ["--build-arg".into(), argument.into()]));
        let mut step = String::new();
        let on_line = |line: &str| {
            if line.starts_with("Step ") {
                line.clone_into(&mut step);
            }
            if let Some(text) = steps::building(line) {
                sender.send(text).ok();
            }
        };
        let done = self.run_build(options, file, context, on_line).await;
        done.map_err(|error| not_built(&step, error))?;
        // It has no name of its own: it is removed with the image on top.
        let id = tokio::fs::read_to_string(id_file).await?;
        self.open_now(&id, name, &project, true).await
    }

    /// Runs `docker build` with these options. `on_line` receives each line that it prints.
    async fn run_build(
        &self,
        options: Vec<OsString>,
        dockerfile: PathBuf,
        context: PathBuf,
        on_line: impl FnMut(&str),
    ) -> Result<(), DockerError> {
        let memory = format!("{}m", self.memory);
        let always = ["build", "--force-rm", "--memory", &memory, "--memory-swap", &memory, "--file"];
        let words = always.map(OsString::from).into_iter().chain([dockerfile.into()]).chain(options);
        let words = words.chain([context.into()]);
        self.docker.follow(words.collect(), self.limit, on_line).await
    }

    /// Creates the image in which the server's user can read the home directory of the image's own user, unless it
    /// exists. Returns its name.
    ///
    /// # Errors
    /// Why it can't be created, as text for the client.
    pub async fn open(
        self: &Arc<Self>,
        id: String,
        project: &Arc<Project>,
        progress: OnProgress<'_>,
    ) -> Result<String, StartError> {
        let name = self.name(std::slice::from_ref(&id));
        let (this, tag, project) = (Arc::clone(self), name.clone(), Arc::clone(project));
        self.once(name, progress, move |_| async move { this.open_now(&id, &tag, &project, false).await }).await
    }

    /// `is_projects` tells whether the project has defined the image, which then is to blame.
    async fn open_now(&self, id: &str, name: &str, project: &Project, is_projects: bool) -> Result<(), StartError> {
        let inspect = ["image", "inspect", "--format", "{{json .Config}}", id];
        let json = self.docker.run(&inspect, SHORT_TIMEOUT).await.map_err(|error| blame(is_projects, error))?;
        let text = ImageConfig::read(&json)?.dockerfile(id, self.owner.name());
        let context = project.instance.path().join(format!("opened-{}", opened::key(&[name.to_owned()])));
        let (dockerfile, folder) = (context.with_extension("Dockerfile"), context.clone());
        let file = dockerfile.clone();
        spawn_blocking(move || std::fs::write(file, text).and_then(|()| opened::write_programs(&folder))).await??;
        let options = ["--network", "none", "--tag", name].map(Into::into).to_vec();
        let done = self.run_build(options, dockerfile, context, |_| ()).await;
        done.map_err(|error| match error {
            DockerError::Slow { limit, .. } if is_projects => StartError::Project(too_slow(limit)),
            error => match StartError::of_project(error) {
                StartError::Project(why) => {
                    StartError::Project(format!("The image can't be prepared for this server's user: {why}"))
                }
                error @ StartError::Server(_) => error,
            },
        })
    }

    /// Runs a job that creates an image, unless it exists. Joins such a job in progress.
    async fn once<F: Future<Output = Result<(), StartError>> + Send + 'static>(
        self: &Arc<Self>,
        name: String,
        progress: OnProgress<'_>,
        job: impl FnOnce(watch::Sender<String>) -> F,
    ) -> Result<String, StartError> {
        if self.id(&name).await?.is_some() {
            return Ok(name);
        }
        self.jobs.join(name.clone(), progress, job).await.map(|()| name)
    }

    async fn permit(&self, sender: &watch::Sender<String>) -> Result<SemaphorePermit<'_>, StartError> {
        if let Ok(permit) = self.builds.try_acquire() {
            return Ok(permit);
        }
        sender.send("waiting for images of others to be built".to_owned()).ok();
        let busy = || format!("Images of others were being built for {} seconds (timing.build)", self.limit.as_secs());
        let permit = actix_rt::time::timeout(self.limit, self.builds.acquire()).await;
        permit.map_err(|_| StartError::Server(busy()))?.map_err(|error| StartError::Server(error.to_string()))
    }

    /// The id of an image, which differs from those of later images of the same name; `None` if it does not exist.
    async fn id(&self, image: &str) -> Result<Option<String>, StartError> {
        match self.docker.run(&["image", "inspect", "--format", "{{.Id}}", image], SHORT_TIMEOUT).await {
            Ok(id) => Ok(Some(id.trim().to_owned())),
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
        let (mine, old) = (format!("label={LABEL}={}", self.owner.name()), format!("until={hours}h"));
        let prune = ["image", "prune", "--force", "--filter", &mine, "--filter"];
        // The images of a build in progress are younger.
        for rest in [&["until=1h"][..], &[&old, "--all"]] {
            self.docker.run(&[&prune, rest].concat(), SHORT_TIMEOUT).await?;
        }
        Ok(())
    }
}

/// Why a configured image can't be pulled, as text for the client.
fn not_pulled(image: &str, error: DockerError) -> StartError {
    match error {
        DockerError::Failed { message, .. } if is_unknown(&message) => no_image(image),
        DockerError::Failed { message, .. } => {
            let is_own = is_disk_full(&message) || is_silent(&message);
            let kind = if is_own { StartError::Server } else { StartError::Project };
            kind(format!("The image {image} can't be fetched: {message}"))
        }
        DockerError::Slow { limit, .. } => StartError::Server(too_slow(limit)),
        DockerError::Unavailable(_) => error.into(),
    }
}

/// Why an image was not built in this step, as text for the client. Only a `FROM` step can fail because of a missing image.
fn not_built(step: &str, error: DockerError) -> StartError {
    let base = step.split_once(" : FROM ").map(|(_, image)| image.split(' ').next().unwrap_or_default());
    match (base, error) {
        (Some(image), DockerError::Failed { message, .. }) if is_unknown(&message) => no_image(image),
        (_, DockerError::Failed { message, .. }) => {
            let kind = if is_disk_full(&message) { StartError::Server } else { StartError::Project };
            kind(format!("The image of this project can't be built: {message} ({step})"))
        }
        (_, DockerError::Slow { limit, .. }) => StartError::Project(too_slow(limit)),
        (_, error) => error.into(),
    }
}

fn too_slow(limit: Duration) -> String {
    format!("Its image was not ready within {} seconds (timing.build)", limit.as_secs())
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
