//! The images of simulations: pulled, built once for all who want the same, and removed when nobody has used them for long.

use std::collections::HashMap;
use std::ffi::OsString;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bytesize::ByteSize;
use jiff::Timestamp;
use tokio::sync::{Semaphore, watch};

use super::docker::{Docker, DockerError, SHORT};
use super::dockerfile::LABEL;
use super::objects::Owner;
use super::steps;
use crate::simulation::checkout::{Project, SingleFlight};

/// The images of this server.
pub struct Images {
    docker: Docker,
    owner: Owner,
    /// How long an image may take.
    limit: Duration,
    /// As many images are built at a time.
    builds: Semaphore,
    jobs: SingleFlight<String, Result<(), String>>,
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

/// An image that this server has built.
#[derive(Debug)]
struct Own {
    name: String,
    /// Bytes.
    size: u64,
    used: Timestamp,
}

impl Images {
    /// The images of this owner.
    #[must_use]
    pub fn new(docker: Docker, owner: Owner, builds: usize, limit: Duration) -> Self {
        Self { docker, owner, limit, builds: Semaphore::new(builds), jobs: SingleFlight::default() }
    }

    /// The name under which this server keeps its images. No other image has it.
    fn repository(&self) -> String {
        format!("webots-fleet/{}", self.owner.name())
    }

    /// Makes sure that an image is there that somebody publishes.
    ///
    /// # Errors
    /// Why it can't be had, in words for the client.
    pub async fn pull(self: &Arc<Self>, image: &str, progress: &(impl Fn(String) + Send + Sync)) -> Result<(), String> {
        if self.is_there(image).await? {
            return Ok(());
        }
        let (this, name) = (Arc::clone(self), image.to_owned());
        let start = move |news| async move { this.limited(this.pull_now(&name, news)).await };
        self.jobs.join(image.to_owned(), progress, start).await
    }

    async fn pull_now(&self, image: &str, news: watch::Sender<String>) -> Result<(), String> {
        let _permit = self.permit(&news).await?;
        let told = |line: &str| drop(news.send(steps::pulling(image, line)));
        let words = ["pull", image].map(OsString::from).to_vec();
        self.docker.follow(words, self.limit, told).await.map_err(|error| not_pulled(image, &error))
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
        if self.is_there(&name).await? {
            // So it counts as used just now.
            self.docker.run(&["tag", &name, &name], SHORT).await.map_err(|error| error.to_string())?;
            return Ok(name);
        }
        let (this, image) = (Arc::clone(self), name.clone());
        let start = move |news| async move { this.limited(this.build_now(&image, build, news)).await };
        self.jobs.join(name.clone(), progress, start).await.map(|()| name)
    }

    async fn build_now(&self, name: &str, build: Build, news: watch::Sender<String>) -> Result<(), String> {
        let _permit = self.permit(&news).await?;
        let mut words =
            ["build", "--force-rm", "--network", build.network, "--tag", name, "--file"].map(OsString::from).to_vec();
        words.push(build.dockerfile.clone().into());
        words.extend(build.arguments.iter().flat_map(|argument| ["--build-arg".into(), argument.into()]));
        words.push(build.context.clone().into());
        let mut step = String::new();
        let told = |line: &str| {
            if line.starts_with("Step ") {
                line.clone_into(&mut step);
            }
            if let Some(text) = steps::building(line) {
                news.send(text).ok();
            }
        };
        let done = self.docker.follow(words, self.limit, told).await;
        // Until here the folder that is copied from has to stay.
        drop(build.project);
        done.map_err(|error| not_built(&step, &error))
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

    async fn is_there(&self, image: &str) -> Result<bool, String> {
        match self.docker.run(&["image", "inspect", "--format", "{{.Id}}", image], SHORT).await {
            Ok(_) => Ok(true),
            Err(DockerError::Failed { .. }) => Ok(false),
            Err(error) => Err(error.to_string()),
        }
    }

    /// Where an image wants to keep data: such places would be on the disk of the machine, without any limit.
    ///
    /// # Errors
    /// When Docker fails.
    pub async fn volumes(&self, image: &str) -> Result<Vec<String>, String> {
        let format = "{{range $path, $_ := .Config.Volumes}}{{println $path}}{{end}}";
        let listed = self.docker.run(&["image", "inspect", "--format", format, image], SHORT).await;
        let listed = listed.map_err(|error| error.to_string())?;
        Ok(listed.lines().map(str::trim).filter(|path| path.starts_with('/')).map(str::to_owned).collect())
    }

    /// Removes the images that this server has built and that nobody has used for so long, or that are too many for this
    /// many bytes; and what builds that failed have left. Those in `kept` stay.
    pub async fn prune(&self, age: Duration, size: u64, kept: &[String]) {
        if let Err(error) = self.prune_now(age, size, kept).await {
            log::warn!("images that nobody needs are not removed: {error}");
        }
    }

    async fn prune_now(&self, age: Duration, size: u64, kept: &[String]) -> Result<(), DockerError> {
        // What a build that is under way makes is younger.
        let (mine, left) = (format!("label={LABEL}={}", self.owner.name()), "until=1h");
        self.docker.run(&["image", "prune", "--force", "--filter", &mine, "--filter", left], SHORT).await?;
        for name in removable(self.own().await?, kept, age, size) {
            log::info!("the image {name} is removed: nobody needs it");
            // One that a container uses stays.
            if let Err(error) = self.docker.run(&["image", "rm", &name], SHORT).await {
                log::debug!("{error}");
            }
        }
        Ok(())
    }

    /// The images that this server has built. What they share with others does not count for their size.
    async fn own(&self) -> Result<Vec<Own>, DockerError> {
        let repository = self.repository();
        let names =
            self.docker.run(&["image", "ls", "--format", "{{.Repository}}:{{.Tag}}", &repository], SHORT).await?;
        let names: Vec<&str> = names.lines().collect();
        if names.is_empty() {
            return Ok(Vec::new());
        }
        let format = "{{range .Images}}{{.Repository}}:{{.Tag}} {{.UniqueSize}}{{println}}{{end}}";
        let sizes = self.docker.run(&["system", "df", "--verbose", "--format", format], SHORT).await?;
        let sizes: HashMap<&str, &str> = sizes.lines().filter_map(|line| line.trim().split_once(' ')).collect();
        let mut own = Vec::new();
        for name in names {
            let format = "{{json .Metadata.LastTagTime}}";
            let used = self.docker.run(&["image", "inspect", "--format", format, name], SHORT).await?;
            let used: Option<Timestamp> = used.trim().trim_matches('"').parse().ok();
            let size: Option<ByteSize> = sizes.get(name).and_then(|size| size.parse().ok());
            let size = size.map_or(0, |size| size.as_u64());
            own.push(Own { name: name.to_owned(), size, used: used.unwrap_or_else(Timestamp::now) });
        }
        Ok(own)
    }
}

/// Those images that can go, the longest unused first.
fn removable(mut own: Vec<Own>, kept: &[String], age: Duration, most: u64) -> Vec<String> {
    own.retain(|image| !kept.contains(&image.name));
    own.sort_by_key(|image| std::cmp::Reverse(image.used));
    let oldest = Timestamp::now().checked_sub(age).unwrap_or(Timestamp::MIN);
    let mut total = 0_u64;
    let too_many = own.into_iter().filter(|image| {
        total = total.saturating_add(image.size);
        image.used < oldest || total > most
    });
    let mut names: Vec<String> = too_many.map(|image| image.name).collect();
    names.reverse();
    names
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
    fn the_longest_unused_images_go_first_and_those_that_are_to_be_kept_stay() {
        let hours = |hours| Timestamp::now().checked_sub(Duration::from_hours(hours)).unwrap();
        let own = |name: &str, size, used| Own { name: name.to_owned(), size, used: hours(used) };
        let all = || vec![own("old", 1, 100), own("new", 5, 1), own("middle", 5, 2), own("kept", 50, 200)];
        let kept = ["kept".to_owned()];
        let days = Duration::from_hours(48);
        assert_eq!(removable(all(), &kept, days, 100), ["old"]);
        assert_eq!(removable(all(), &kept, days, 9), ["old", "middle"]);
        assert!(removable(all(), &kept, Duration::from_hours(1000), 100).is_empty());
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
