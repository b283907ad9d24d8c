//! The images of simulations: pulled, and built once for all clients of the same project.

use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Semaphore, watch};

use super::blocking::blocking;
use super::compose_project::DEFAULT_MEMORY;
use super::docker::{Docker, DockerError, SHORT};
use super::opened::{self, About};
use super::owned_resources::ResourceOwner;
use super::start_error::{StartError, is_disk_full};
use super::steps;
use crate::simulation::checkout::{Project, SingleFlight};
use crate::simulation::config::SimulationConfig;

/// The images of this server.
pub struct Images {
    pub(super) docker: Docker,
    pub(super) owner: ResourceOwner,
    /// The registries of the configured images, and Docker Hub's.
    registries: [String; 3],
    /// Timeout of an image.
    limit: Duration,
    /// Memory limit of a build step, in MiB.
    memory: u64,
    /// Limits concurrent builds.
    builds: Semaphore,
    jobs: SingleFlight<String, Result<(), StartError>>,
}

/// An image to build.
#[derive(Debug, Clone)]
pub struct Build {
    /// Key of this image, unique among those of the server.
    pub key: String,
    /// The Dockerfile, a file outside of the project.
    pub dockerfile: PathBuf,
    /// The directory that it copies from.
    pub context: PathBuf,
    /// Arguments, as `NAME=value`.
    pub arguments: Vec<String>,
    /// The Docker network that it may use.
    pub network: &'static str,
    /// The project, kept until the build has ended.
    pub project: Arc<Project>,
}

/// The kind of an error, by its cause.
type Whose = fn(String) -> StartError;

impl Images {
    /// The images of this owner.
    #[must_use]
    pub fn new(docker: Docker, owner: ResourceOwner, config: &SimulationConfig) -> Self {
        let (builds, limit) = (Semaphore::new(config.container.builds), config.timing.build);
        let memory = config.limits.memory.unwrap_or(DEFAULT_MEMORY);
        let registries = ["", &config.container.image, &config.container.editor_image];
        let registries = registries.map(|image| registry(image).to_owned());
        Self { docker, owner, registries, limit, memory, builds, jobs: SingleFlight::default() }
    }

    /// The repository name of this server's images; unique.
    pub(super) fn repository(&self) -> String {
        format!("webots-fleet/{}", self.owner.name())
    }

    /// Pulls a published image unless it exists. Returns its id, which differs from those of later images of the same
    /// name.
    ///
    /// # Errors
    /// Why it can't be pulled, as text for the client.
    pub async fn pull(
        self: &Arc<Self>,
        image: &str,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<String, StartError> {
        if let Some(id) = self.id(image).await? {
            return Ok(id);
        }
        let (this, name) = (Arc::clone(self), image.to_owned());
        let start = move |news| async move { this.pull_now(&name, news).await };
        self.jobs.join(image.to_owned(), progress, start).await?;
        self.id(image).await?.ok_or_else(|| StartError::Server(format!("The image {image} was removed meanwhile")))
    }

    async fn pull_now(&self, image: &str, news: watch::Sender<String>) -> Result<(), StartError> {
        let _permit = self.permit(&news).await?;
        let told = |line: &str| drop(news.send(steps::pulling(image, line)));
        let words = ["pull", image].map(OsString::from).to_vec();
        let whose = self.whose(image);
        let pull = async {
            let pulled = self.docker.follow(words, self.limit + SHORT, told).await;
            pulled.map_err(|error| not_pulled(image, error, whose))
        };
        self.limited(pull, whose).await
    }

    /// Builds an image unless it exists. Returns its name.
    ///
    /// # Errors
    /// Why it can't be built, as text for the client.
    pub async fn build(
        self: &Arc<Self>,
        build: Build,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<String, StartError> {
        let name = format!("{}:{}", self.repository(), build.key);
        let (this, made) = (Arc::clone(self), name.clone());
        let job = move |news| async move {
            let _permit = this.permit(&news).await?;
            this.limited(this.build_now(&made, build, news), StartError::Project).await
        };
        self.once(name, progress, job).await
    }

    async fn build_now(&self, name: &str, build: Build, news: watch::Sender<String>) -> Result<(), StartError> {
        let id = build.dockerfile.with_extension("id");
        let mut words: Vec<OsString> = ["--network", build.network, "--iidfile"].map(OsString::from).to_vec();
        words.push(id.clone().into());
        words.extend(build.arguments.iter().flat_map(|argument| ["--build-arg".into(), argument.into()]));
        let mut step = String::new();
        let told = |line: &str| {
            if line.starts_with("Step ") {
                line.clone_into(&mut step);
            }
            if let Some(text) = steps::building(line) {
                news.send(text).ok();
            }
        };
        let done = self.run_build(words, &build.dockerfile, &build.context, told).await;
        done.map_err(|error| not_built(&step, error, |image| self.whose(image)))?;
        // It has no name of its own: it is removed with the image on top.
        let id = blocking(move || std::fs::read_to_string(id)).await?;
        self.open_now(&id, name, &build.project).await
        // The directory that was copied from must exist until here.
    }

    /// Runs `docker build` with these options. `told` receives each line that it prints.
    ///
    /// # Errors
    /// When it fails.
    pub async fn run_build(
        &self,
        options: Vec<OsString>,
        dockerfile: &Path,
        context: &Path,
        told: impl FnMut(&str),
    ) -> Result<(), DockerError> {
        let memory = format!("{}m", self.memory);
        let always = ["build", "--force-rm", "--memory", &memory, "--memory-swap", &memory, "--file"];
        let words = always.map(OsString::from).into_iter().chain(std::iter::once(dockerfile.into()));
        let words = words.chain(options).chain(std::iter::once(context.into())).collect();
        self.docker.follow(words, self.limit + SHORT, told).await
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
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<String, StartError> {
        let name = format!("{}:{}", self.repository(), opened::key(std::iter::once(id.as_str())));
        let (this, made, project) = (Arc::clone(self), name.clone(), Arc::clone(project));
        let job = move |_| async move { this.limited(this.open_now(&id, &made, &project), StartError::Server).await };
        self.once(name, progress, job).await
    }

    /// Runs a job that creates an image, unless it exists. Joins such a job in progress.
    async fn once<F: Future<Output = Result<(), StartError>> + Send + 'static>(
        self: &Arc<Self>,
        name: String,
        progress: &(impl Fn(String) + Send + Sync),
        job: impl FnOnce(watch::Sender<String>) -> F,
    ) -> Result<String, StartError> {
        if self.id(&name).await?.is_some() {
            return Ok(name);
        }
        self.jobs.join(name.clone(), progress, job).await.map(|()| name)
    }

    async fn permit(&self, news: &watch::Sender<String>) -> Result<tokio::sync::SemaphorePermit<'_>, StartError> {
        if let Ok(permit) = self.builds.try_acquire() {
            return Ok(permit);
        }
        news.send("waiting for images of others to be built".to_owned()).ok();
        let busy = || format!("Images of others were being built for {} seconds (timing.build)", self.limit.as_secs());
        let permit = actix_rt::time::timeout(self.limit, self.builds.acquire()).await;
        permit.map_err(|_| StartError::Server(busy()))?.map_err(|error| StartError::Server(error.to_string()))
    }

    /// Runs a job with a timeout, which does not include waiting for others. `whose` is the kind of error after a
    /// timeout.
    async fn limited(&self, job: impl Future<Output = Result<(), StartError>>, whose: Whose) -> Result<(), StartError> {
        let slow = || format!("Its image was not ready within {} seconds (timing.build)", self.limit.as_secs());
        actix_rt::time::timeout(self.limit, job).await.unwrap_or_else(|_| Err(whose(slow())))
    }

    /// The kind of error if the registry of an image does not answer: a project may name any registry.
    fn whose(&self, image: &str) -> Whose {
        let is_ours = self.registries.iter().any(|ours| ours == registry(image));
        if is_ours { StartError::Server } else { StartError::Project }
    }

    /// The id of an image, which differs from those of later images of the same name; `None` if it does not exist.
    ///
    /// # Errors
    /// When Docker fails.
    async fn id(&self, image: &str) -> Result<Option<String>, StartError> {
        match self.docker.run(&["image", "inspect", "--format", "{{.Id}}", image], SHORT).await {
            Ok(id) => Ok(Some(id.lines().last().unwrap_or_default().to_owned())),
            Err(DockerError::Failed { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// The image's configuration of the programs that run in it.
    ///
    /// # Errors
    /// When Docker fails, an entry of the configuration can't be parsed, or the image has a volume.
    pub async fn about(&self, image: &str) -> Result<About, StartError> {
        let answer = self.docker.run(&["image", "inspect", "--format", opened::FORMAT, image], SHORT).await?;
        Ok(About::read(&answer)?)
    }
}

/// The registry of an image; empty for Docker Hub, which has no name there.
fn registry(image: &str) -> &str {
    let (first, _) = image.split_once('/').unwrap_or_default();
    if first.contains(['.', ':']) || first == "localhost" { first } else { "" }
}

/// Why an image can't be pulled, as text for the client. `whose` is the kind of error if its registry does not answer.
fn not_pulled(image: &str, error: DockerError, whose: Whose) -> StartError {
    match error {
        DockerError::Failed { message, .. } if is_unknown(&message) => StartError::Project(format!(
            "There is no image {image} for this version of Webots where this simulation server looks for images. Another \
             version of the world, or a Dockerfile in its project that begins with an image that there is, helps"
        )),
        DockerError::Failed { message, .. } => {
            let kind = match message.as_str() {
                message if is_disk_full(message) => StartError::Server,
                message if is_silent(message) => whose,
                _ => StartError::Project,
            };
            kind(format!("The image {image} can't be fetched: {message}"))
        }
        other => other.into(),
    }
}

/// Why an image was not built, as text for the client. Only a `FROM` step can fail because of a missing image.
fn not_built(step: &str, error: DockerError, whose: impl FnOnce(&str) -> Whose) -> StartError {
    let from = step.split_once(" : ").and_then(|(_, instruction)| instruction.strip_prefix("FROM "));
    match (from, error) {
        (Some(image), error) => {
            let image = image.split(' ').next().unwrap_or_default();
            not_pulled(image, error, whose(image))
        }
        (None, DockerError::Failed { message, .. }) => {
            let kind = if is_disk_full(&message) { StartError::Server } else { StartError::Project };
            kind(format!("The image of this project can't be built: {message} ({step})"))
        }
        (None, other) => other.into(),
    }
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

impl fmt::Debug for Images {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Images")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_that_is_not_there_is_told_in_words_and_only_where_a_stage_begins() {
        let failed =
            |message: &str| DockerError::Failed { command: "docker build".to_owned(), message: message.to_owned() };
        let built = |step: &str, error| not_built(step, error, |_| StartError::Server);
        let told = built("Step 1/4 : FROM cyberbotics/webots.cloud:R1-ubuntu22.04 AS a", failed("manifest unknown"));
        let told = told.to_string();
        assert!(
            told.starts_with("There is no image cyberbotics/webots.cloud:R1-ubuntu22.04 for this version"),
            "{told}"
        );
        let told = built("Step 2/4 : RUN make", failed("make: not found"));
        let words = "The image of this project can't be built: make: not found (Step 2/4 : RUN make)";
        assert_eq!(told, StartError::Project(words.to_owned()));
        let gone = built("Step 2/4 : RUN make", DockerError::NoDaemon("refused".to_owned()));
        assert!(matches!(gone, StartError::Server(_)), "{gone:?}");
        let full = built("Step 3/4 : COPY . /x", failed("write /x: no space left on device"));
        assert!(matches!(full, StartError::Server(_)), "{full:?}");
    }

    #[test]
    fn a_registry_that_does_not_answer_is_the_fault_of_who_has_named_it() {
        let failed =
            |message: &str| DockerError::Failed { command: "docker pull".to_owned(), message: message.to_owned() };
        let limited = || failed("toomanyrequests: You have reached your pull rate limit");
        assert!(matches!(not_pulled("a", limited(), StartError::Server), StartError::Server(_)));
        assert!(matches!(not_pulled("a", limited(), StartError::Project), StartError::Project(_)));
        let full = failed("failed to register layer: write /x: no space left on device");
        assert!(matches!(not_pulled("a", full, StartError::Project), StartError::Server(_)));
        for (image, expected) in
            [("debian", ""), ("lab/a:1", ""), ("b.c/a", "b.c"), ("localhost/a", "localhost"), ("b:5000/a:1", "b:5000")]
        {
            assert_eq!(registry(image), expected, "{image}");
        }
    }
}
