//! The images of simulations: pulled, and built once for all clients of the same project.

use std::collections::HashMap;
use std::ffi::OsString;
use std::net::IpAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix_rt::task::spawn_blocking;
use parking_lot::Mutex;

use super::build_plan::{self, ImageBuild};
use super::builders::{Builder, Builders};
use super::built_image::BuiltImage;
use super::compose_project::DEFAULT_MEMORY;
use super::docker::{Docker, DockerError, SHORT_TIMEOUT, daemon_fault, data_folder, docker_disk_fault};
use super::dockerfile::Dockerfile;
use super::engine;
use super::failures::{of_project, on_thread};
use super::growth::{self, BuildMark};
use super::image_store::{ImageStore, ImageUse};
use super::owned_resources::ResourceOwner;
use crate::shared::domain::{Failure, Reason};
use crate::simulation::checkout::{Project, SingleFlight, Steps};
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::{DiskRoom, own_call_failed};
use crate::simulation::progress::{MAX_STEPS, OnProgress, Progress, Step};

/// The images of this server.
pub struct Images {
    docker: Docker,
    /// The owner in their labels.
    pub owner: ResourceOwner,
    config: Arc<SimulationConfig>,
    /// What becomes of them.
    pub store: Arc<ImageStore>,
    builders: Builders,
    jobs: SingleFlight<String, Result<(), Failure>>,
    /// The builds and pulls that run, each with the free room of Docker's disk at its begin, in bytes.
    running: Mutex<HashMap<BuildMark, u64>>,
    /// When a build was last ended because it has filled the disk.
    ended: tokio::sync::Mutex<Option<Instant>>,
}

/// A build or pull that runs. Dropping it ends its entry.
struct RunningBuild<'images> {
    mark: BuildMark,
    images: &'images Images,
}

impl Drop for RunningBuild<'_> {
    fn drop(&mut self) {
        self.images.running.lock().remove(&self.mark);
    }
}

/// How a Dockerfile names the image of the world's version of Webots.
const DEFAULT_BASE: [&str; 2] = ["$WEBOTS_DEFAULT_IMAGE", "${WEBOTS_DEFAULT_IMAGE}"];
/// Formats of `docker image inspect`: the id, which differs from those of later images of the same name, the size in
/// bytes with the configuration of the image's programs.
const ID: &str = "{{.Id}}";
const SIZE_AND_CONFIG: &str = "{{.Size}} {{json .Config}}";
/// The longest version of a world that has an image.
const MAX_VERSION: usize = 50;
/// Interval between two looks at the disk of Docker during a build.
const LOOK_INTERVAL: Duration = Duration::from_secs(1);
/// Time in which Docker removes the files of a build that was ended.
const RELIEF: Duration = Duration::from_secs(3);

impl Images {
    /// The images of this owner.
    pub fn new(docker: Docker, owner: ResourceOwner, config: Arc<SimulationConfig>) -> Self {
        let builders = Builders::new(config.container.builds);
        let store = Arc::new(ImageStore::new(docker.clone(), owner.clone(), Arc::clone(&config)));
        Self {
            docker,
            owner,
            config,
            store,
            builders,
            jobs: SingleFlight::default(),
            running: Mutex::default(),
            ended: tokio::sync::Mutex::default(),
        }
    }

    /// Pulls a configured image unless it exists, for a client with this address. Returns its id, which differs from those
    /// of later images of the same name.
    ///
    /// # Errors
    /// Why it can't be pulled.
    pub async fn pull(
        self: &Arc<Self>,
        image: &str,
        address: Option<IpAddr>,
        progress: OnProgress<'_>,
    ) -> Result<String, Failure> {
        let this = Arc::clone(self);
        let name = image.to_owned();
        let pull = move |steps: Steps| async move {
            let _builder = this.builder(address, &steps).await?;
            let _running = this.running_build().await;
            let on_line = |line: &str| steps.send(numbered(1, MAX_STEPS, format!("fetching {name}: {line}")));
            this.store.expect(&name);
            let command = ["docker", "pull", &name].map(OsString::from).to_vec();
            let pulled = this.docker.follow(command, this.config.timing.build, on_line).await;
            match pulled {
                Ok(()) => {
                    this.store.added();
                    Ok(())
                }
                Err(error) => Err(this.not_pulled(&name, error).await),
            }
        };
        self.made(image, ID, progress, pull).await
    }

    /// Builds an image of a project unless it exists, for a client with this address. The image stays as long as it is used.
    ///
    /// # Errors
    /// Why it can't be built or used.
    pub async fn build(
        self: &Arc<Self>,
        project: &Arc<Project>,
        mut build: ImageBuild,
        address: Option<IpAddr>,
        progress: OnProgress<'_>,
    ) -> Result<(BuiltImage, Vec<ImageUse>), Failure> {
        let version = &project.world.version;
        let webots = build_plan::image_of(&self.config.container.image, version);
        if !is_version(version) {
            return Err(no_image(&webots));
        }
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
        let mut uses = Vec::new();
        for base in &build.dockerfile.bases {
            let is_default = DEFAULT_BASE.contains(&base.as_str());
            uses.push(self.store.keep(if is_default { &webots } else { base }));
            let id = if is_default {
                Some(self.pull(&webots, address, progress).await?)
            } else {
                self.inspect(base, ID).await?
            };
            if id.is_none() {
                self.store.expect(base);
            }
            parts.extend(id);
        }
        let name = self.store.name(&parts);
        uses.push(self.store.keep(&name));
        let this = Arc::clone(self);
        let project = Arc::clone(project);
        let tag = name.clone();
        let is_projects = build.folder.is_some();
        let job = move |steps: Steps| async move {
            // A build without steps of a project takes seconds, and is as large as the image of Webots.
            if build.folder.is_none() {
                return this.build_now(&tag, &project, build, &steps).await;
            }
            let _builder = this.builder(address, &steps).await?;
            let done = this.build_now(&tag, &project, build, &steps).await;
            this.store.added();
            done
        };
        let found = self.made(&name, SIZE_AND_CONFIG, progress, job).await?;
        let (size, config) = found.split_once(' ').unwrap_or_default();
        if is_projects {
            self.check_size(&name, size).await?;
        }
        let image = BuiltImage::read(name, config).map_err(of_project)?;
        Ok((image, uses))
    }

    /// Makes an image by this job unless it exists. Returns what Docker reports about it in this format.
    async fn made<F: Future<Output = Result<(), Failure>> + Send + 'static>(
        &self,
        name: &str,
        format: &str,
        progress: OnProgress<'_>,
        job: impl FnOnce(Steps) -> F,
    ) -> Result<String, Failure> {
        if let Some(found) = self.inspect(name, format).await? {
            return Ok(found);
        }
        self.jobs.join(name.to_owned(), progress, job).await?;
        // The settings that a project's Dockerfile makes may be too large to be read.
        let unreadable = || of_project(format!("The settings of the image {name} can't be read"));
        self.inspect(name, format).await?.ok_or_else(unreadable)
    }

    async fn build_now(&self, name: &str, project: &Project, build: ImageBuild, steps: &Steps) -> Result<(), Failure> {
        let ImageBuild {
            dockerfile,
            folder,
            arguments,
        } = build;
        let Dockerfile { text, bases } = dockerfile;
        let instance = project.instance.path().to_owned();
        let root = project.folder.clone();
        let prepare = move || {
            let file = instance.join(format!("Dockerfile{}", folder.unwrap_or_default()));
            let empty = instance.join("empty");
            std::fs::write(&file, text)
                .and_then(|()| std::fs::create_dir_all(&empty))
                .map_err(|error| own_call_failed(&error))?;
            // A copy out of an image may have replaced it by a symlink to any path.
            let context = folder.map_or(Ok(empty), |folder| build_plan::inside(&root, Path::new(folder)));
            Ok((file, context.map_err(of_project)?))
        };
        let (file, context) = on_thread(prepare).await?;
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
        let running = self.running_build().await;
        let words = limited
            .into_iter()
            .chain(options)
            .map(OsString::from)
            .chain([file.into()])
            .chain(running.mark.option().map(Into::into));
        let arguments = arguments
            .into_iter()
            .flat_map(|argument| ["--build-arg".into(), argument.into()]);
        let words = words.chain(arguments).chain([context.into()]);
        let mut step = String::new();
        let on_line = |line: &str| {
            if let Some(progress) = scaled(line) {
                line.clone_into(&mut step);
                steps.send(progress);
            }
        };
        let follow = self.docker.follow(words.collect(), self.config.timing.build, on_line);
        let done = tokio::select! {
            done = follow => done,
            failure = self.until_ended(&running.mark) => return Err(failure),
        };
        match done {
            Ok(()) => Ok(()),
            Err(error) => Err(self.not_built(&bases, &step, error).await),
        }
    }

    /// Checks the size in bytes of an image that was built for a project, whenever it is used. Removes one that is too large.
    async fn check_size(&self, name: &str, size: &str) -> Result<(), Failure> {
        let limit = self.config.container.image_size;
        if size.parse().is_ok_and(|size: u64| size <= limit << 20) {
            return Ok(());
        }
        // It may be gone already, or take long on a disk that other builds write to. Nobody gets it meanwhile.
        let removed = self.docker.run(&["image", "rm", name], self.config.timing.build).await;
        if let Err(error) = removed {
            log::debug!("{name} is not removed: {error}");
        }
        let message = format!("The image of this project is larger than {limit} MiB (container.imageSize)");
        Err(Failure::new(Reason::ImageTooLarge, message))
    }

    /// A build or pull that begins now.
    async fn running_build(&self) -> RunningBuild<'_> {
        let mark = BuildMark::new();
        let free = spawn_blocking(free_room).await.ok().flatten().unwrap_or_default();
        self.running.lock().insert(mark.clone(), free);
        RunningBuild { mark, images: self }
    }

    /// Waits until the disk of Docker has less than `diskReserve` left, and this build may be why.
    async fn until_ended(&self, mark: &BuildMark) -> Failure {
        let reserve = self.config.disk_reserve;
        loop {
            actix_rt::time::sleep(LOOK_INTERVAL).await;
            if !matches!(spawn_blocking(move || docker_disk_fault(reserve)).await, Ok(Some(_))) {
                continue;
            }
            let mut ended = self.ended.lock().await;
            if ended.is_some_and(|ended| ended.elapsed() < RELIEF) {
                continue;
            }
            let fillers = self.fillers().await;
            if *fillers == [mark.clone()] {
                *ended = Some(Instant::now());
                return filled_by_project();
            }
            if fillers.contains(mark) {
                return self.has_filled_disk();
            }
        }
    }

    /// The builds and pulls that may have taken the room that the disk of Docker has lost since the first of those that run
    /// began.
    async fn fillers(&self) -> Vec<BuildMark> {
        let running = self.running.lock().clone();
        let marks: Vec<BuildMark> = running.keys().cloned().collect();
        let before = running.values().copied().max().unwrap_or_default();
        let now = spawn_blocking(free_room).await.ok().flatten();
        match (now, growth::written(&self.docker, &marks).await) {
            (Some(now), Ok(written)) => growth::fillers(&marks, &written, before.saturating_sub(now)),
            // Nothing is known: it may be any.
            _ => marks,
        }
    }

    /// The failure of a build during which the disk of Docker has become full: the server takes no clients with a full
    /// disk, so builds have filled it. Of several builds none is known to be the cause.
    fn has_filled_disk(&self) -> Failure {
        if self.builders.in_use() > 1 {
            let message = "The builds of several projects have filled the disk of Docker (diskReserve), and were ended";
            return Failure::new(Reason::BuildersBusy, message);
        }
        filled_by_project()
    }

    /// Why a configured image can't be pulled: the world's version has none, or this server can't get it. Nothing here is
    /// a project's: the image is the configuration's, and its registry answers.
    async fn not_pulled(&self, image: &str, error: DockerError) -> Failure {
        if engine::is_unknown(image).await {
            return no_image(image);
        }
        let message = format!("This simulation server can't fetch the image {image}");
        let otherwise = Failure::new(Reason::ServerFault, message);
        self.docker.explain(error, self.config.disk_reserve, otherwise).await
    }

    /// Why an image with these bases was not built, in this step.
    async fn not_built(&self, bases: &[String], step: &str, error: DockerError) -> Failure {
        if let DockerError::Slow { limit, .. } = error {
            if let Ok(Some(fault)) = spawn_blocking(daemon_fault).await {
                return fault;
            }
            let message = format!(
                "Its image was not ready within {} seconds (timing.build)",
                limit.as_secs()
            );
            return Failure::new(Reason::BuildTimeout, message);
        }
        // A build fetches each base that is not there, except an earlier stage or one that a variable names.
        let mut missing = None;
        for base in bases.iter().filter(|base| !base.contains('$')) {
            if missing.is_none() && matches!(self.inspect(base, ID).await, Ok(None)) {
                missing = Some(base);
            }
        }
        let message = match missing {
            Some(base) if instruction(step).is_some_and(|(_, what)| what.starts_with("FROM ")) => format!(
                "The image of this project can't be built: this simulation server can't fetch the image {base}, with \
                 which it begins"
            ),
            _ => "The image of this project can't be built".to_owned(),
        };
        let failed = Failure::new(Reason::BuildFailed, message);
        let explained = self.docker.explain(error, self.config.disk_reserve, failed).await;
        match (explained.reason, explained.output) {
            (Reason::DiskFull, _) => self.has_filled_disk(),
            (Reason::BuildFailed, Some(output)) => {
                Failure::new(Reason::BuildFailed, explained.message).with_output(format!("{output} ({step})"))
            }
            (reason, output) => Failure {
                reason,
                message: explained.message,
                output,
            },
        }
    }

    /// Waits until another image may be built or pulled for this address.
    async fn builder(&self, address: Option<IpAddr>, steps: &Steps) -> Result<Builder<'_>, Failure> {
        let limit = self.config.timing.build;
        let on_wait = || steps.send(Progress::new(Step::Image, "waiting for other images to be built"));
        let builder = self.builders.take(address, limit, on_wait).await;
        builder.ok_or_else(|| {
            let limit = limit.as_secs();
            let message = format!("Other images were being built for {limit} s (timing.build)");
            Failure::new(Reason::BuildersBusy, message)
        })
    }

    /// What Docker reports about an image in this format; `None` if it does not exist.
    async fn inspect(&self, image: &str, format: &str) -> Result<Option<String>, Failure> {
        match self
            .docker
            .run(&["image", "inspect", "--format", format, image], SHORT_TIMEOUT)
            .await
        {
            Ok(found) => Ok(Some(found.trim().to_owned())),
            // Also if Docker does not answer.
            Err(DockerError::Failed { .. }) => match spawn_blocking(daemon_fault).await {
                Ok(Some(fault)) => Err(fault),
                _ => Ok(None),
            },
            Err(error) => Err(error.into()),
        }
    }
}

/// The step of a build, from Docker's line about it, in at most nine steps; `None` for any other line.
fn scaled(line: &str) -> Option<Progress> {
    let (numbers, instruction) = instruction(line)?;
    let (step, of) = numbers.split_once('/')?;
    let (step, of): (u64, u64) = (step.parse().ok()?, of.parse().ok()?);
    let step = if of > MAX_STEPS {
        (step.saturating_mul(MAX_STEPS) / of).max(1)
    } else {
        step
    };
    Some(numbered(step, of.min(MAX_STEPS), instruction.to_owned()))
}

/// The numbers and the instruction in Docker's line about a step.
fn instruction(line: &str) -> Option<(&str, &str)> {
    line.strip_prefix("Step ")?.split_once(" : ")
}

fn numbered(number: u64, of: u64, text: String) -> Progress {
    Progress {
        of_all: Some((number, of)),
        ..Progress::new(Step::Image, text)
    }
}

/// The failure of a build that has filled the disk of Docker.
fn filled_by_project() -> Failure {
    let message = "The image of this project can't be built: it has filled the disk of Docker (diskReserve)";
    Failure::new(Reason::ImageTooLarge, message)
}

/// The free room of the disk of Docker, in bytes. Blocks.
fn free_room() -> Option<u64> {
    Some(DiskRoom::of(&data_folder()?).ok()?.bytes)
}

fn no_image(image: &str) -> Failure {
    let message = format!(
        "There is no image {image} for this version of Webots where this simulation server looks for images. Another \
         version of the world, or a Dockerfile in its project that begins with an image that there is, helps"
    );
    Failure::new(Reason::ImageNotFound, message)
}

/// Whether a world's version can be part of the name of an image.
fn is_version(version: &str) -> bool {
    let is_plain = |letter: u8| letter.is_ascii_alphanumeric() || b"._-".contains(&letter);
    version.len() <= MAX_VERSION && version.bytes().all(is_plain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_version_is_a_part_of_a_name() {
        for (version, is_one) in [
            ("R2025a", true),
            ("R2023b-rev.1", true),
            ("a/b", false),
            ("R2025a@x", false),
        ] {
            assert_eq!(is_version(version), is_one, "{version}");
        }
        assert!(!is_version(&"R".repeat(100)));
    }

    #[test]
    fn steps_have_one_digit() {
        for (said, told) in [
            ("Step 2/4 : RUN make", Some((2, 4, "RUN make"))),
            ("Step 10/20 : COPY . /x", Some((4, 9, "COPY . /x"))),
            ("Step 1/20 : FROM a", Some((1, 9, "FROM a"))),
            ("Step into the light", None),
            (" ---> Running in 0123", None),
        ] {
            assert_eq!(
                scaled(said),
                told.map(|(number, of, text)| numbered(number, of, text.to_owned()))
            );
        }
    }
}
