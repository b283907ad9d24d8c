//! The images that this server has built or pulled: how much room they take, when each was used, and which are removed.
//!
//! An image that was built has the owner's label. One that was pulled can't get a label: it gets another name, that of the
//! owner with `base-` in its tag.

use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use jiff::Timestamp;
use parking_lot::Mutex;
use sha2::{Digest, Sha256};
use tokio::sync::Notify;

use super::docker::{Docker, DockerError, SHORT_TIMEOUT, daemon_fault, docker_disk_fault};
use super::dockerfile::LABEL;
use super::engine::with_tag;
use super::owned_resources::ResourceOwner;
use crate::shared::domain::ProjectUrl;
use crate::shared::run::seconds_since_1970;
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::has_several_runs;

/// The images of a server.
pub struct ImageStore {
    docker: Docker,
    owner: ResourceOwner,
    config: Arc<SimulationConfig>,
    uses: Arc<Mutex<HashMap<String, Use>>>,
    /// The images of the last simulation of each world that is kept ready.
    worlds: Mutex<HashMap<ProjectUrl, Vec<String>>>,
    /// Images that were not there, and are pulled, or will be by a build.
    expected: Mutex<HashSet<String>>,
    /// Signals that there are more images.
    growth: Notify,
}

/// The uses of an image in this run of the server.
#[derive(Debug, Default)]
struct Use {
    /// Number of builds and simulations that need it now, and have no container of it yet.
    now: usize,
    /// The end of the last one, in seconds since 1970.
    last: u64,
}

/// The use of an image, which is not removed meanwhile. Dropping it ends the use.
#[derive(Debug)]
pub struct ImageUse {
    name: String,
    uses: Arc<Mutex<HashMap<String, Use>>>,
}

/// An image of this machine, as Docker reports it.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Image {
    id: String,
    /// With those that it begins with, in bytes.
    size: u64,
    /// When it was built, in seconds since 1970.
    built: u64,
    /// When it got its last name, in seconds since 1970.
    named: u64,
    /// Whether this server has built it.
    is_built: bool,
    names: Vec<String>,
    layers: Vec<String>,
}

/// Interval between two prunings, and after a failed one: Docker runs one at a time, also of other servers.
const PRUNE_INTERVAL: Duration = Duration::from_mins(5);
const RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// Minimum age of leftovers of failed builds that are removed because the disk is full, in minutes.
const MIN_AGE: u64 = 5;
/// What is read about an image.
const FORMAT: &str = "{{.Id}} {{.Size}} {{json .Created}} {{json .Metadata.LastTagTime}} {{json .RepoTags}} \
    {{json .RepoDigests}} {{json .RootFS.Layers}}";
/// Number of images that are read at a time.
const AT_A_TIME: usize = 100;
/// The beginning of the tag of an image that was pulled.
const BASE: &str = "base-";

impl Drop for ImageUse {
    fn drop(&mut self) {
        let mut uses = self.uses.lock();
        let of_image = uses.entry(self.name.clone()).or_default();
        of_image.now -= 1;
        of_image.last = seconds_since_1970();
    }
}

impl Image {
    /// Parses a line of [`FORMAT`]. `built_here` are the ids of those that this server has built.
    fn read(line: &str, built_here: &HashSet<&str>) -> Option<Self> {
        let mut words = line.split(' ');
        let (id, size, built, named) = (words.next()?, words.next()?, words.next()?, words.next()?);
        let mut list = || serde_json::from_str::<Option<Vec<String>>>(words.next()?).ok();
        let (tags, digests, layers) = (list()?, list()?, list()?);
        Some(Self {
            id: id.to_owned(),
            size: size.parse().ok()?,
            built: seconds(built).unwrap_or_default(),
            named: seconds(named).unwrap_or_default(),
            is_built: built_here.contains(id),
            names: tags.into_iter().chain(digests).flatten().collect(),
            layers: layers.unwrap_or_default(),
        })
    }

    /// Whether it has a name with this beginning.
    fn is_named(&self, beginning: &str) -> bool {
        self.names.iter().any(|name| name.starts_with(beginning))
    }

    /// Whether it begins with another image.
    fn contains(&self, other: &Self) -> bool {
        let is_after = (self.layers.len(), &self.id) > (other.layers.len(), &other.id);
        let begin = self.layers.get(..other.layers.len());
        // Images of different projects often begin with the same layers: the last one tells soonest.
        is_after && begin.is_some_and(|begin| begin.iter().rev().eq(other.layers.iter().rev()))
    }
}

/// The room that the images take that are `own`, in bytes, besides those of others with which they begin. What several
/// have in common counts once: the builder keeps an image without a name for each step.
fn room(all: &[Image], is_own: impl Fn(&Image) -> bool) -> u64 {
    let is_of_others = |image: &Image| !image.names.is_empty() && !is_own(image);
    let is_below = |image: &Image, is_above: &dyn Fn(&Image) -> bool| {
        let mut above = all.iter().filter(|other| is_above(other));
        above.any(|other| other.contains(image))
    };
    let counts = |image: &&Image| {
        is_own(image) || image.names.is_empty() && is_below(image, &is_own) && !is_below(image, &is_of_others)
    };
    let besides_below = |image: &Image| {
        let below = all.iter().filter(|other| image.contains(other)).map(|other| other.size);
        image.size.saturating_sub(below.max().unwrap_or_default())
    };
    all.iter().filter(counts).map(besides_below).sum()
}

/// The name by which Docker lists an image that a configuration or a Dockerfile names so.
fn listed_name(name: &str) -> String {
    let name = name.strip_prefix("docker.io/").unwrap_or(name);
    with_tag(name.strip_prefix("library/").unwrap_or(name))
}

/// A time in JSON, in seconds since 1970; `None` for the year 1, which an image without a name has.
fn seconds(json: &str) -> Option<u64> {
    let time: Timestamp = json.trim_matches('"').parse().ok()?;
    time.as_second().try_into().ok()
}

impl ImageStore {
    /// The images of this owner.
    pub fn new(docker: Docker, owner: ResourceOwner, config: Arc<SimulationConfig>) -> Self {
        Self {
            docker,
            owner,
            config,
            uses: Arc::default(),
            worlds: Mutex::default(),
            expected: Mutex::default(),
            growth: Notify::new(),
        }
    }

    /// The name of an image that this server builds from these parts.
    pub fn name(&self, parts: &[String]) -> String {
        format!("{}{}", self.prefix(), hex::encode(Sha256::digest(parts.join("\0"))))
    }

    /// Keeps an image until the returned value is dropped.
    pub fn keep(&self, name: &str) -> ImageUse {
        let name = listed_name(name);
        self.uses.lock().entry(name.clone()).or_default().now += 1;
        ImageUse {
            name,
            uses: Arc::clone(&self.uses),
        }
    }

    /// Notes which images a simulation of a world has, which is kept ready.
    pub fn used_for(&self, world: &ProjectUrl, uses: &[ImageUse]) {
        let names = uses.iter().map(|one| one.name.clone()).collect();
        self.worlds.lock().insert(world.clone(), names);
    }

    /// Keeps the images that were noted for a world in this run, until the returned values are dropped.
    pub fn keep_for(&self, world: &ProjectUrl) -> Vec<ImageUse> {
        let names = self.worlds.lock().get(world).cloned().unwrap_or_default();
        names.iter().map(|name| self.keep(name)).collect()
    }

    /// Notes that an image is not there, and will be pulled.
    pub fn expect(&self, name: &str) {
        self.expected.lock().insert(listed_name(name));
    }

    /// Notes that this server has built or pulled an image.
    pub fn added(&self) {
        self.growth.notify_one();
    }

    /// Removes what is too much: images that were not used for long, and leftovers of failed builds; above
    /// `container.imagesSize`, and while the disk is full, those that were not used for longest. Images that a container
    /// uses stay, those of worlds that are kept ready, and those that this server has neither built nor pulled. Never
    /// returns.
    pub async fn keep_within_limits(self: Arc<Self>) {
        loop {
            let is_done = match self.clean().await {
                Ok(has_room) => has_room,
                Err(error) => {
                    // Docker may be away.
                    log::debug!("images are looked at again later: {error}");
                    false
                }
            };
            let pause = if is_done { PRUNE_INTERVAL } else { RETRY_INTERVAL };
            actix_rt::time::timeout(pause, self.growth.notified()).await.ok();
        }
    }

    /// Returns whether the disk has room now.
    async fn clean(&self) -> Result<bool, DockerError> {
        self.mark_pulled().await;
        let is_full = self.is_disk_full().await;
        let minutes = if is_full {
            MIN_AGE
        } else {
            24 * 60 * self.config.container.images_age
        };
        let mine = format!("label={LABEL}={}", self.owner.0);
        let old = format!("until={minutes}m");
        let prune = ["image", "prune", "--force", "--filter", &mine, "--filter", &old];
        if let Err(error) = self.docker.run(&prune, SHORT_TIMEOUT).await {
            // Docker prunes for one at a time.
            log::debug!("leftovers of builds stay for now: {error}");
        }
        // Another process of this server may need an image of which it has no container yet.
        let cache = self.config.cache_dir.0.clone();
        if spawn_blocking(move || !has_several_runs(&cache)).await.unwrap_or(false) {
            self.evict().await?;
        }
        Ok(!self.is_disk_full().await)
    }

    /// Names the images that were pulled, so that they are known after a restart.
    async fn mark_pulled(&self) {
        let expected = self.expected.lock().clone();
        for name in expected {
            let mark = format!("{}{BASE}{}", self.prefix(), hex::encode(Sha256::digest(&name)));
            let is_there = self.docker.run(&["tag", &name, &mark], SHORT_TIMEOUT).await.is_ok();
            // Unless Docker does not answer, its build has failed, or it is the name of another stage.
            let is_missing = !is_there && matches!(spawn_blocking(daemon_fault).await, Ok(None));
            if is_there || is_missing && !self.is_in_use(&name) {
                self.expected.lock().remove(&name);
            }
        }
    }

    async fn is_disk_full(&self) -> bool {
        let reserve = self.config.disk_reserve;
        matches!(spawn_blocking(move || docker_disk_fault(reserve)).await, Ok(Some(_)))
    }

    /// Removes images, those first that were not used for longest: while the disk is full or they take too much, and
    /// those that are old.
    async fn evict(&self) -> Result<(), DockerError> {
        let limit = self.config.container.images_size << 20;
        let oldest = seconds_since_1970().saturating_sub(self.config.container.images_age * 24 * 60 * 60);
        let mut all = self.all().await?;
        let names: HashSet<&String> = all.iter().flat_map(|image| &image.names).collect();
        let is_there = |name: &String, of_image: &mut Use| of_image.now > 0 || names.contains(name);
        self.uses.lock().retain(is_there);
        let are_there = |images: &mut Vec<String>| images.iter().any(|name| names.contains(name));
        self.worlds.lock().retain(|_, images| are_there(images));
        let mut stays: Vec<String> = Vec::new();
        loop {
            let is_own = |image: &Image| self.is_own(image);
            let own: Vec<&Image> = all.iter().filter(|image| is_own(image)).collect();
            let total = room(&all, is_own);
            let is_too_much = total > limit || self.is_disk_full().await;
            let candidates = own.into_iter().filter(|image| {
                (is_too_much || self.last_use(image) < oldest)
                    && !stays.contains(&image.id)
                    && !self.is_permanent(image)
            });
            // What begins with another image goes before it.
            let Some(first) = candidates.min_by_key(|image| (self.last_use(image), Reverse(image.layers.len()))) else {
                return Ok(());
            };
            let Image { id, names, .. } = first.clone();
            if !self.remove(first).await? {
                stays.push(id);
                continue;
            }
            all = self.all().await?;
            // Its names, of which Docker removes some with others, tell more than the exit code.
            if all.iter().any(|image| image.id == id && !image.names.is_empty()) {
                stays.push(id);
            } else {
                log::info!("removed the image {}", names.join(" "));
            }
        }
    }

    /// Removes an image with all of its names, unless it is used. Returns whether it has tried.
    async fn remove(&self, image: &Image) -> Result<bool, DockerError> {
        let of_image = format!("ancestor={}", image.id);
        let users = ["ps", "--all", "--quiet", "--filter", &of_image];
        let has_containers = !self.docker.run(&users, SHORT_TIMEOUT).await?.trim().is_empty();
        if has_containers || image.names.iter().any(|name| self.is_in_use(name)) {
            return Ok(false);
        }
        let words: Vec<&str> = ["image", "rm"]
            .into_iter()
            .chain(image.names.iter().map(String::as_str))
            .collect();
        // It fails if a container has just been created. On a busy disk it takes minutes.
        self.docker.run(&words, self.config.timing.build).await.ok();
        Ok(true)
    }

    fn prefix(&self) -> String {
        format!("webots-fleet/{}:", self.owner.0)
    }

    fn mark(&self) -> String {
        format!("{}{BASE}", self.prefix())
    }

    /// Whether this server has built or pulled it. One without a name is a leftover, or a step of another.
    fn is_own(&self, image: &Image) -> bool {
        image.is_built && !image.names.is_empty() || image.is_named(&self.prefix())
    }

    fn is_in_use(&self, name: &str) -> bool {
        self.uses.lock().get(name).is_some_and(|of_image| of_image.now > 0)
    }

    /// Whether the administrator wants to keep it.
    fn is_permanent(&self, image: &Image) -> bool {
        let mut permanent = self.config.persistant_docker_images.iter();
        permanent.any(|name| image.names.contains(&listed_name(name)))
    }

    /// When an image was last used, built or pulled, in seconds since 1970.
    fn last_use(&self, image: &Image) -> u64 {
        let uses = self.uses.lock();
        let ends = image
            .names
            .iter()
            .filter_map(|name| uses.get(name))
            .map(|of_image| of_image.last);
        // A pulled one may have been built years ago.
        let begin = if image.is_named(&self.mark()) {
            image.named
        } else {
            image.built
        };
        ends.max().unwrap_or_default().max(begin)
    }

    /// All images of this machine.
    async fn all(&self) -> Result<Vec<Image>, DockerError> {
        let list = ["image", "ls", "--all", "--quiet", "--no-trunc"];
        let list = self.docker.run(&list, SHORT_TIMEOUT).await?;
        let mut ids: Vec<&str> = list.lines().collect();
        ids.sort_unstable();
        ids.dedup();
        // Labels can't be read with the rest: a project's may be of any size.
        let mine = format!("label={LABEL}={}", self.owner.0);
        let built = ["image", "ls", "--quiet", "--no-trunc", "--filter", &mine];
        let built = self.docker.run(&built, SHORT_TIMEOUT).await?;
        let built: HashSet<&str> = built.lines().collect();
        let mut all = Vec::new();
        for some in ids.chunks(AT_A_TIME) {
            let words: Vec<&str> = ["image", "inspect", "--format", FORMAT]
                .into_iter()
                .chain(some.iter().copied())
                .collect();
            let told = match self.docker.run(&words, SHORT_TIMEOUT).await {
                // Others may be gone meanwhile.
                Err(DockerError::Failed { found, .. }) if !found.is_empty() => found,
                told => told?,
            };
            all.extend(told.lines().filter_map(|line| Image::read(line, &built)));
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(id: &str, size: u64, layers: &str, name: &str) -> Image {
        let layers: Vec<String> = layers.chars().map(|layer| format!("\"{layer}\"")).collect();
        let names = if name.is_empty() {
            "null".to_owned()
        } else {
            format!("[\"{name}\"]")
        };
        let time = "2026-11-24T10:35:49.97185664+01:00";
        let layers = layers.join(",");
        let line = format!(r#"{id} {size} "2026-11-24T08:35:49Z" "{time}" {names} null [{layers}]"#);
        Image::read(&line, &HashSet::from(["a"])).unwrap()
    }

    #[test]
    fn a_line_of_docker_is_read() {
        let read = image("a", 7, "xy", "webots-fleet/o:a");
        assert_eq!((read.size, read.built, read.named), (7, 1_795_509_349, 1_795_512_949));
        assert!(read.is_built && !image("b", 7, "xy", "webots-fleet/o:a").is_built);
        assert_eq!(read.names, ["webots-fleet/o:a"]);
        assert_eq!(read.layers, ["x", "y"]);
        assert_eq!(seconds("\"0001-01-01T00:00:00Z\""), None);
    }

    #[test]
    fn a_name_is_as_docker_lists_it() {
        for (name, listed) in [
            ("debian", "debian:latest"),
            ("docker.io/library/debian:12", "debian:12"),
            ("docker.io/lab/arm", "lab/arm:latest"),
            ("127.0.0.1:5000/lab/arm", "127.0.0.1:5000/lab/arm:latest"),
            ("lab/arm@sha256:0123", "lab/arm@sha256:0123"),
            ("webots-fleet/o:a", "webots-fleet/o:a"),
        ] {
            assert_eq!(listed_name(name), listed);
        }
    }

    #[test]
    fn what_images_have_in_common_counts_once_and_what_is_of_others_not() {
        let is_own = |image: &Image| image.is_named("own");
        let all = [
            image("a", 90, "w", ""),
            image("b", 100, "wx", "others"),
            image("c", 130, "wxy", ""),
            image("d", 130, "wxy", "own1"),
            image("e", 140, "wxyz", "own2"),
            image("f", 500, "v", ""),
        ];
        assert_eq!(room(&all, is_own), 40);
        assert_eq!(room(&all, |_| false), 0);
    }
}
