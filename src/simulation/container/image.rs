//! The images of simulations: pulled, and built once for all clients of the same project; old ones are removed.

use std::ffi::OsString;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use tokio::sync::{Semaphore, SemaphorePermit, watch};

use super::build_plan::{self, ImageBuild};
use super::built_image::BuiltImage;
use super::compose_project::DEFAULT_MEMORY;
use super::docker::{Docker, DockerError, SHORT_TIMEOUT, StartError, data_folder, is_disk_full};
use super::dockerfile::LABEL;
use super::owned_resources::{ResourceOwner, digest};
use crate::simulation::checkout::{OnProgress, Project, SingleFlight};
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::DiskRoom;

/// The images of this server.
pub struct Images {
    docker: Docker,
    /// The owner in their labels.
    pub owner: ResourceOwner,
    config: Arc<SimulationConfig>,
    /// Limits concurrent builds.
    builds: Semaphore,
    jobs: SingleFlight<String, Result<(), StartError>>,
}

/// How a Dockerfile names the image of the world's version of Webots.
const DEFAULT_BASE: [&str; 2] = ["$WEBOTS_DEFAULT_IMAGE", "${WEBOTS_DEFAULT_IMAGE}"];
/// Formats of `docker image inspect`: the id, which differs from those of later images of the same name, and the
/// configuration of the image's programs.
const ID: &str = "{{.Id}}";
const CONFIG: &str = "{{json .Config}}";
/// The largest number of steps that Webots' page understands: each number has one digit.
const STEPS: u64 = 9;
/// Interval between two prunings, and after a failed one: Docker runs one at a time, also of other servers.
const PRUNE_INTERVAL: Duration = Duration::from_mins(5);
const RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// Minimum age of an image that is removed because the disk is full, in hours: a newly built one has no container yet.
const MIN_AGE: u64 = 1;

impl Images {
    /// The images of this owner.
    pub fn new(docker: Docker, owner: ResourceOwner, config: Arc<SimulationConfig>) -> Self {
        let builds = Semaphore::new(config.container.builds);
        Self {
            docker,
            owner,
            config,
            builds,
            jobs: SingleFlight::default(),
        }
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
            let on_line = |line: &str| drop(sender.send(format!("Step 1/{STEPS} : fetching {name}: {line}")));
            let command = ["docker", "pull", &name].map(OsString::from).to_vec();
            let pulled = this.docker.follow(command, this.config.timing.build, on_line).await;
            pulled.map_err(|error| not_pulled(&name, error))
        };
        self.made(image, ID, progress, pull).await
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
        parts.extend(
            build
                .folder
                .into_iter()
                .flat_map(|folder| [project.identity(), folder.to_owned()]),
        );
        // An image's name stays the same when the image is updated, so its id is part of the key. A base that is not
        // here yet has no id: the build fetches it.
        for base in &build.dockerfile.bases {
            let is_default = DEFAULT_BASE.contains(&base.as_str());
            parts.extend(if is_default {
                Some(self.pull(&webots, progress).await?)
            } else {
                self.inspect(base, ID).await?
            });
        }
        let name = format!("webots-fleet/{}:{}", self.owner.0, digest(parts.join("\0").as_bytes()));
        let (this, project, tag) = (Arc::clone(self), Arc::clone(project), name.clone());
        let job = |sender| async move { this.build_now(&tag, &project, build, sender).await };
        let config = self.made(&name, CONFIG, progress, job).await?;
        Ok(BuiltImage::read(name, &config)?)
    }

    /// Makes an image by this job unless it exists. Returns what Docker reports about it in this format.
    async fn made<F: Future<Output = Result<(), StartError>> + Send + 'static>(
        &self,
        name: &str,
        format: &str,
        progress: OnProgress<'_>,
        job: impl FnOnce(watch::Sender<String>) -> F,
    ) -> Result<String, StartError> {
        if let Some(found) = self.inspect(name, format).await? {
            return Ok(found);
        }
        self.jobs.join(name.to_owned(), progress, job).await?;
        // The settings that a project's Dockerfile makes may be too large to be read.
        let unreadable = || StartError::Project(format!("The settings of the image {name} can't be read"));
        self.inspect(name, format).await?.ok_or_else(unreadable)
    }

    async fn build_now(
        &self,
        name: &str,
        project: &Project,
        build: ImageBuild,
        sender: watch::Sender<String>,
    ) -> Result<(), StartError> {
        // A build without steps of a project takes seconds.
        let _permit = if build.folder.is_some() {
            Some(self.permit(&sender).await?)
        } else {
            None
        };
        let ImageBuild {
            dockerfile,
            folder,
            arguments,
        } = build;
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
        let limited = [
            "docker",
            "build",
            "--force-rm",
            "--memory",
            &memory,
            "--memory-swap",
            &memory,
        ];
        let options = ["--network", network, "--tag", name, "--file"];
        let words = limited
            .into_iter()
            .chain(options)
            .map(OsString::from)
            .chain([file.into()]);
        let arguments = arguments
            .into_iter()
            .flat_map(|argument| ["--build-arg".into(), argument.into()]);
        let words = words.chain(arguments).chain([context.into()]);
        let mut step = String::new();
        let on_line = |line: &str| {
            if let Some(text) = scaled(line) {
                line.clone_into(&mut step);
                sender.send(text).ok();
            }
        };
        let done = self
            .docker
            .follow(words.collect(), self.config.timing.build, on_line)
            .await;
        done.map_err(|error| not_built(&step, error))
    }

    /// Waits until another image may be built or pulled.
    async fn permit(&self, sender: &watch::Sender<String>) -> Result<SemaphorePermit<'_>, StartError> {
        if let Ok(permit) = self.builds.try_acquire() {
            return Ok(permit);
        }
        sender.send("waiting for images of others to be built".to_owned()).ok();
        let limit = self.config.timing.build;
        let why = || {
            format!(
                "Images of others were being built for {} s (timing.build)",
                limit.as_secs()
            )
        };
        let permit = actix_rt::time::timeout(limit, self.builds.acquire())
            .await
            .ok()
            .and_then(Result::ok);
        permit.ok_or_else(|| StartError::Server(why()))
    }

    /// What Docker reports about an image in this format; `None` if it does not exist.
    async fn inspect(&self, image: &str, format: &str) -> Result<Option<String>, StartError> {
        match self
            .docker
            .run(&["image", "inspect", "--format", format, image], SHORT_TIMEOUT)
            .await
        {
            Ok(found) => Ok(Some(found.trim().to_owned())),
            Err(DockerError::Failed { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes old images that this server has built and no container uses, and leftovers of failed builds. Images
    /// without this server's label stay, such as base images. Never returns.
    pub async fn remove_old(self: Arc<Self>) {
        let reserve = self.config.disk_reserve;
        loop {
            let room = || data_folder().and_then(|folder| DiskRoom::of(&folder).ok());
            let room = spawn_blocking(room).await.ok().flatten();
            let is_full = room.is_some_and(|room| room.shortage(reserve).is_some());
            let hours = if is_full {
                MIN_AGE
            } else {
                24 * self.config.container.images_age
            };
            let (mine, old) = (format!("label={LABEL}={}", self.owner.0), format!("until={hours}h"));
            let prune = [
                "image", "prune", "--all", "--force", "--filter", &mine, "--filter", &old,
            ];
            let pruned = self.docker.run(&prune, SHORT_TIMEOUT).await;
            actix_rt::time::sleep(if pruned.is_ok() { PRUNE_INTERVAL } else { RETRY_INTERVAL }).await;
        }
    }
}

/// The step of a build, from Docker's line about it, in at most nine steps; `None` for any other line.
fn scaled(line: &str) -> Option<String> {
    let (numbers, instruction) = line.strip_prefix("Step ")?.split_once(" : ")?;
    let (step, of) = numbers.split_once('/')?;
    let (step, of): (u64, u64) = (step.parse().ok()?, of.parse().ok()?);
    let step = if of > STEPS {
        (step.saturating_mul(STEPS) / of).max(1)
    } else {
        step
    };
    Some(format!("Step {step}/{} : {instruction}", of.min(STEPS)))
}

/// Why a configured image can't be pulled: the world's version has none, or this server can't get it.
fn not_pulled(image: &str, error: DockerError) -> StartError {
    match error {
        DockerError::Failed { message, .. } if is_unknown(&message) => no_image(image),
        error => error.into(),
    }
}

/// Why an image was not built in this step. Only a `FROM` step can fail because of a missing image.
fn not_built(step: &str, error: DockerError) -> StartError {
    let base = step
        .split_once(" : FROM ")
        .and_then(|(_, image)| image.split(' ').next());
    match (base, error) {
        (Some(image), DockerError::Failed { message, .. }) if is_unknown(&message) => no_image(image),
        (_, DockerError::Failed { message, .. }) if !is_disk_full(&message) => {
            StartError::Project(format!("The image of this project can't be built: {message} ({step})"))
        }
        (_, DockerError::Slow { limit, .. }) => StartError::Project(format!(
            "Its image was not ready within {} seconds (timing.build)",
            limit.as_secs()
        )),
        (_, error) => error.into(),
    }
}

fn no_image(image: &str) -> StartError {
    StartError::Project(format!(
        "There is no image {image} for this version of Webots where this simulation server looks for images. Another \
         version of the world, or a Dockerfile in its project that begins with an image that there is, helps"
    ))
}

/// Whether a registry reports that there is no such image, or Docker that its name is invalid.
fn is_unknown(message: &str) -> bool {
    let words = [
        "not found",
        "pull access denied",
        "manifest unknown",
        "repository does not exist",
        "invalid reference",
    ];
    words.iter().any(|words| message.contains(words))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failed(message: &str) -> DockerError {
        DockerError::Failed {
            command: "docker build".to_owned(),
            message: message.to_owned(),
        }
    }

    #[test]
    fn a_missing_image_is_reported_only_where_a_stage_begins() {
        let told = not_built(
            "Step 1/4 : FROM cyberbotics/webots.cloud:R1-ubuntu22.04 AS a",
            failed("manifest unknown"),
        );
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
    fn a_failing_registry_is_blamed_on_whoever_named_it() {
        let limited = || failed("toomanyrequests: You have reached your pull rate limit");
        assert!(matches!(not_pulled("a", limited()), StartError::Server(_)));
        assert!(matches!(
            not_built("Step 1/4 : FROM a", limited()),
            StartError::Project(_)
        ));
        assert!(matches!(
            not_pulled("a", failed("invalid reference format")),
            StartError::Project(_)
        ));
        let full = failed("failed to register layer: write /x: no space left on device");
        assert!(matches!(not_built("Step 1/4 : FROM a", full), StartError::Server(_)));
    }

    #[test]
    fn steps_have_one_digit() {
        for (said, told) in [
            ("Step 2/4 : RUN make", Some("Step 2/4 : RUN make")),
            ("Step 10/20 : COPY . /x", Some("Step 4/9 : COPY . /x")),
            ("Step 1/20 : FROM a", Some("Step 1/9 : FROM a")),
            ("Step into the light", None),
            (" ---> Running in 0123", None),
        ] {
            assert_eq!(scaled(said).as_deref(), told);
        }
    }
}
