//! The images of simulations: pulled, and built once for all who want the same.

use std::collections::HashMap;
use std::ffi::OsString;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{Semaphore, watch};

use super::blocking::blocking;
use super::compose::DEFAULT_MEMORY;
use super::docker::{Docker, DockerError, SHORT};
use super::objects::Owner;
use super::opened::{self, About};
use super::steps;
use crate::simulation::checkout::{Project, SingleFlight};
use crate::simulation::config::SimulationConfig;

/// The images of this server.
pub struct Images {
    pub(super) docker: Docker,
    pub(super) owner: Owner,
    /// How long an image may take.
    limit: Duration,
    /// How much memory a step of a build may take, in MiB.
    memory: u64,
    /// As many images are built at a time.
    builds: Semaphore,
    jobs: SingleFlight<String, Result<(), String>>,
    /// The places of data that images of this server declare, by their names, which never mean another image.
    volumes: Mutex<HashMap<String, Vec<String>>>,
}

/// An image to be built.
#[derive(Debug, Clone)]
pub struct Build {
    /// What tells this image from others.
    pub key: String,
    /// The Dockerfile, a file outside of the project.
    pub dockerfile: PathBuf,
    /// The folder that it copies from.
    pub context: PathBuf,
    /// Arguments, as `NAME=value`.
    pub arguments: Vec<String>,
    /// The Docker network that it may use.
    pub network: &'static str,
    /// The project, which stays as long as it is built.
    pub project: Arc<Project>,
}

impl Images {
    /// The images of this owner.
    #[must_use]
    pub fn new(docker: Docker, owner: Owner, config: &SimulationConfig) -> Self {
        let (builds, limit) = (Semaphore::new(config.container.builds), config.timing.build);
        let memory = config.limits.memory.unwrap_or(DEFAULT_MEMORY);
        Self { docker, owner, limit, memory, builds, jobs: SingleFlight::default(), volumes: Mutex::default() }
    }

    /// The name under which this server keeps its images. No other image has it.
    pub(super) fn repository(&self) -> String {
        format!("webots-fleet/{}", self.owner.name())
    }

    /// Makes sure that a published image is there. Returns its id, by which it is told from later ones of the same name.
    ///
    /// # Errors
    /// Why it can't be pulled, in words for the client.
    pub async fn pull(
        self: &Arc<Self>,
        image: &str,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<String, String> {
        if let Some(id) = self.id(image).await? {
            return Ok(id);
        }
        let (this, name) = (Arc::clone(self), image.to_owned());
        let start = move |news| async move { this.limited(this.pull_now(&name, news)).await };
        self.jobs.join(image.to_owned(), progress, start).await?;
        self.id(image).await?.ok_or_else(|| format!("The image {image} was removed meanwhile"))
    }

    async fn pull_now(&self, image: &str, news: watch::Sender<String>) -> Result<(), String> {
        let _permit = self.permit(&news).await?;
        let told = |line: &str| drop(news.send(steps::pulling(image, line)));
        let words = ["pull", image].map(OsString::from).to_vec();
        self.docker.follow(words, self.limit + SHORT, told).await.map_err(|error| not_pulled(image, &error))
    }

    /// Builds an image, unless it is there. Returns its name.
    ///
    /// # Errors
    /// Why it can't be built, in words for the client.
    pub async fn build(
        self: &Arc<Self>,
        build: Build,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<String, String> {
        let name = format!("{}:{}", self.repository(), build.key);
        let (this, made) = (Arc::clone(self), name.clone());
        self.once(name, progress, move |news| async move { this.build_now(&made, build, news).await }).await
    }

    async fn build_now(&self, name: &str, build: Build, news: watch::Sender<String>) -> Result<(), String> {
        let _permit = self.permit(&news).await?;
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
        done.map_err(|error| not_built(&step, &error))?;
        // It has no name of its own: what it takes of the disk counts for the image on top.
        let id = blocking(move || std::fs::read_to_string(id).map_err(|error| error.to_string())).await?;
        self.open_now(&id, name, &build.project).await
        // Until here the folder that was copied from has to stay.
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

    /// Makes the image in which the server's user finds what the image's own user has at home, unless it is there. Returns
    /// its name.
    ///
    /// # Errors
    /// Why it can't be made, in words for the client.
    pub async fn open(
        self: &Arc<Self>,
        id: String,
        project: &Arc<Project>,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<String, String> {
        let name = format!("{}:{}", self.repository(), opened::key(std::iter::once(id.as_str())));
        let (this, made, project) = (Arc::clone(self), name.clone(), Arc::clone(project));
        self.once(name, progress, move |_| async move { this.open_now(&id, &made, &project).await }).await
    }

    /// Has a job make an image, unless it is there. Joins one that is doing so.
    async fn once<F: Future<Output = Result<(), String>> + Send + 'static>(
        self: &Arc<Self>,
        name: String,
        progress: &(impl Fn(String) + Send + Sync),
        job: impl FnOnce(watch::Sender<String>) -> F,
    ) -> Result<String, String> {
        // One that is there counts as used just now.
        match self.docker.run(&["tag", &name, &name], SHORT).await {
            Ok(_) => return Ok(name),
            Err(DockerError::Failed { .. }) => {}
            Err(error) => return Err(error.to_string()),
        }
        let this = Arc::clone(self);
        let start = move |news| {
            let job = job(news);
            async move { this.limited(job).await }
        };
        self.jobs.join(name.clone(), progress, start).await.map(|()| name)
    }

    async fn permit(&self, news: &watch::Sender<String>) -> Result<tokio::sync::SemaphorePermit<'_>, String> {
        if let Ok(permit) = self.builds.try_acquire() {
            return Ok(permit);
        }
        news.send("waiting for images of others to be built".to_owned()).ok();
        self.builds.acquire().await.map_err(|error| error.to_string())
    }

    /// Each job has a limit of time, in which it may also wait for others.
    async fn limited(&self, job: impl Future<Output = Result<(), String>>) -> Result<(), String> {
        let slow = || format!("Its image was not ready within {} seconds (timing.build)", self.limit.as_secs());
        actix_rt::time::timeout(self.limit, job).await.unwrap_or_else(|_| Err(slow()))
    }

    /// What tells an image from later ones of the same name; `None` if it is not there.
    ///
    /// # Errors
    /// When Docker fails.
    async fn id(&self, image: &str) -> Result<Option<String>, String> {
        match self.docker.run(&["image", "inspect", "--format", "{{.Id}}", image], SHORT).await {
            Ok(id) => Ok(Some(id.lines().last().unwrap_or_default().to_owned())),
            Err(DockerError::Failed { .. }) => Ok(None),
            Err(error) => Err(error.to_string()),
        }
    }

    /// What an image says of the programs that run in it.
    ///
    /// # Errors
    /// When Docker fails, or a word of them is too long.
    pub async fn about(&self, image: &str) -> Result<About, String> {
        let answer = self.docker.run(&["image", "inspect", "--format", opened::FORMAT, image], SHORT).await;
        let answer = answer.map_err(|error| error.to_string())?;
        About::read(&answer)
            .ok_or_else(|| format!("The image {image} has an ENTRYPOINT or CMD that can't be read here"))
    }

    /// Where an image wants to keep data: such places would be on the disk of the machine, without any limit.
    ///
    /// # Errors
    /// When Docker fails, or such a place has a name that only its own author understands.
    pub async fn volumes(&self, image: &str) -> Result<Vec<String>, String> {
        let known = || self.volumes.lock();
        if let Some(found) = known().get(image).cloned() {
            return Ok(found);
        }
        let format = "{{range $path, $_ := .Config.Volumes}}{{printf \"%+q\" $path}}{{println}}{{end}}";
        let listed = self.docker.run(&["image", "inspect", "--format", format, image], SHORT).await;
        let listed = listed.map_err(|error| error.to_string())?;
        let strange =
            |path: &str| format!("The image {image} has a VOLUME {path}, which can't be given to a container here");
        let found = listed.lines().map(|path| place_of(path).ok_or_else(|| strange(path)));
        let found: Vec<String> = found.collect::<Result<_, String>>()?;
        if image.starts_with(&self.repository()) {
            known().insert(image.to_owned(), found.clone());
        }
        Ok(found)
    }
}

/// The place of a volume, from its quoted name: from the root on and without detours, as Docker reads it.
fn place_of(quoted: &str) -> Option<String> {
    let name = quoted.strip_prefix('"')?.strip_suffix('"')?;
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "/._-+@".contains(letter);
    let mut place = Vec::new();
    for part in name.split('/') {
        match part {
            "" | "." => {}
            ".." => drop(place.pop()),
            part => place.push(part),
        }
    }
    (name.starts_with('/') && name.chars().all(is_plain)).then(|| format!("/{}", place.join("/")))
}

/// Why an image is not there, in words for the client.
fn not_pulled(image: &str, error: &DockerError) -> String {
    match error {
        DockerError::Failed { message, .. } if is_unknown(message) => format!(
            "There is no image {image} for this version of Webots where this simulation server looks for images. Another \
             version of the world, or a Dockerfile in its project that begins with an image that there is, helps"
        ),
        DockerError::Failed { message, .. } => format!("The image {image} can't be fetched: {message}"),
        other => other.to_string(),
    }
}

/// Why an image was not built, in words for the client. Only a step that begins with an image can miss it.
fn not_built(step: &str, error: &DockerError) -> String {
    let from = step.split_once(" : ").and_then(|(_, instruction)| instruction.strip_prefix("FROM "));
    match (from, error) {
        (Some(image), error) => not_pulled(image.split(' ').next().unwrap_or_default(), error),
        (None, DockerError::Failed { message, .. }) => {
            format!("The image of this project can't be built: {message} ({step})")
        }
        (None, other) => other.to_string(),
    }
}

/// Whether a registry says that there is no such image.
fn is_unknown(message: &str) -> bool {
    ["not found", "pull access denied", "manifest unknown", "repository does not exist"]
        .iter()
        .any(|words| message.contains(words))
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
    fn a_volume_is_known_by_the_place_where_docker_puts_it() {
        for (name, place) in [
            ("\"/data\"", Some("/data")),
            ("\"data\"", None),
            ("\"/x/..//./data/\"", Some("/data")),
            ("\"/\"", Some("/")),
            ("\"\"", None),
            ("\"/a:size=1\"", None),
            ("\"/a\\n/b\"", None),
            ("\"/a,b\"", None),
            ("\"/aaaa", None),
        ] {
            assert_eq!(place_of(name).as_deref(), place, "{name}");
        }
    }

    #[test]
    fn an_image_that_is_not_there_is_told_in_words_and_only_where_a_stage_begins() {
        let failed =
            |message: &str| DockerError::Failed { command: "docker build".to_owned(), message: message.to_owned() };
        let told =
            not_built("Step 1/4 : FROM cyberbotics/webots.cloud:R1-ubuntu22.04 AS a", &failed("manifest unknown"));
        assert!(
            told.starts_with("There is no image cyberbotics/webots.cloud:R1-ubuntu22.04 for this version"),
            "{told}"
        );
        let told = not_built("Step 2/4 : RUN make", &failed("make: not found"));
        assert_eq!(told, "The image of this project can't be built: make: not found (Step 2/4 : RUN make)");
    }
}
