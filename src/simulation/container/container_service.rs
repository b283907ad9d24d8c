//! Creates the containers of simulations; one for the whole server.

use std::io;
use std::path::Path;
use std::sync::Arc;

use tokio::sync::{OnceCell, Semaphore};
use tokio_util::task::AbortOnDropHandle;

use super::blocking::blocking;
use super::build_plan::{self, BuildPlan, PROJECT_PATH};
use super::compose_project::{ComposeProject, container_of};
use super::container_request::{ContainerRequest, command};
use super::docker::{Docker, SHORT};
use super::docker_features::DockerFeatures;
use super::image::Images;
use super::image_export::ImageExport;
use super::network;
use super::orphan_cleanup::{ActiveProjects, run_cleanup};
use super::owned_resources::{self, ResourceOwner};
use super::packet_filter;
use super::project_images::Part;
use super::project_paths::{edited_folder, participant_folder, project_folder, volume_of, world_in};
use super::simulation_containers::{ProjectGuard, SimulationContainers};
use super::start_error::{StartError, blame};
use super::steps;
use super::templates::Templates;
use super::webots_yml::ProjectKind;
use crate::simulation::config::SimulationConfig;

/// Creates the containers of simulations.
#[derive(Debug)]
pub struct ContainerService {
    docker: Docker,
    owner: ResourceOwner,
    run: ResourceOwner,
    templates: Templates,
    images: Arc<Images>,
    live: ActiveProjects,
    engine: OnceCell<DockerFeatures>,
    shortcoming: Option<String>,
    /// Limits concurrent runs of compose.
    turns: Semaphore,
    config: Arc<SimulationConfig>,
    _keeper: AbortOnDropHandle<()>,
}

impl ContainerService {
    /// Opens the service on the thread of this runtime. `run` is the directory of this run of the server. Removes what
    /// an earlier run has left. Blocks for a moment.
    ///
    /// # Errors
    /// When Docker or compose is not installed, as text for an administrator.
    pub fn open(config: Arc<SimulationConfig>, run: &Path) -> Result<Self, String> {
        let docker = Docker::find(run)?;
        let owner = ResourceOwner::of(&config.cache_dir.0);
        owned_resources::sweep(&owner);
        let this_run = owner.run();
        let shortcoming = packet_filter::missing();
        if let Some(why) = &shortcoming {
            log::warn!("{why}");
        }
        let templates = Templates::of(&config.container);
        templates.faults().iter().for_each(|fault| log::error!("{fault}"));
        let images = Images::new(docker.clone(), owner.clone(), &config);
        let (images, live) = (Arc::new(images), ActiveProjects::default());
        let keeper = run_cleanup(docker.clone(), owner.clone(), live.clone(), Arc::clone(&images), Arc::clone(&config));
        let keeper = AbortOnDropHandle::new(actix_rt::spawn(keeper));
        Ok(Self {
            docker,
            owner,
            run: this_run,
            templates,
            images,
            live,
            engine: OnceCell::new(),
            shortcoming,
            turns: Semaphore::new(2 * std::thread::available_parallelism().map_or(2, usize::from)),
            config,
            _keeper: keeper,
        })
    }

    /// The owner of these containers, for a process that removes them after the server's end.
    #[must_use]
    pub fn run(&self) -> &ResourceOwner {
        &self.run
    }

    /// What containers can do because the packet filter is missing; `None` if it is loaded.
    #[must_use]
    pub fn shortcoming(&self) -> Option<&str> {
        self.shortcoming.as_deref()
    }

    /// Creates the containers of a simulation, but starts none. `progress` receives each step as text.
    ///
    /// Dropping the future discards everything that was created.
    ///
    /// # Errors
    /// Why they can't be created, and whether the project or this server is the cause.
    pub async fn prepare(
        &self,
        request: ContainerRequest,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<SimulationContainers, StartError> {
        let recipe = self.recipe(&request).await?;
        let lease = ProjectGuard::take(self.run.project(request.port), &self.live);
        let network = self.config.container.network.name();
        let joined = network::join(&self.docker, network);
        let version = &request.project.world.version;
        let base = build_plan::image_of(&self.config.container.image, version);
        let part =
            |text, folder| Part { project: &request.project, base: &base, text, folder, make: recipe.make, network };
        let image = if let Some(text) = &recipe.dockerfile {
            joined.await?;
            let image = self.images.of_project(part(text, ""), progress).await?;
            self.copy(&lease, &image, PROJECT_PATH.to_owned(), &request, request.project.folder()).await?;
            image
        } else {
            let ((), id) = tokio::try_join!(joined, self.images.pull(&base, progress))?;
            self.images.open(id, &request.project, progress).await?
        };
        let controller = match &recipe.controller {
            Some(text) => {
                let image = self.images.of_project(part(text, "controllers"), progress).await?;
                let folder = recipe.asks.kind.folder_in_project().unwrap_or_default();
                let from = Path::new(PROJECT_PATH).join(folder).to_string_lossy().into_owned();
                self.copy(&lease, &image, from, &request, &participant_folder(&request.project)).await?;
                Some(image)
            }
            None => None,
        };
        if recipe.asks.kind != ProjectKind::Default {
            self.images.pull(&self.config.container.editor_image, progress).await?;
        }
        self.make(request, recipe, lease, (image, controller), progress).await
    }

    async fn recipe(&self, request: &ContainerRequest) -> Result<BuildPlan, StartError> {
        let (folder, templates) = (request.project.folder().to_owned(), self.templates.clone());
        let owner = self.owner.name().to_owned();
        blocking(move || BuildPlan::read(&folder, &templates, &owner)).await
    }

    /// Copies a directory of an image into the instance's directory.
    async fn copy(
        &self,
        lease: &ProjectGuard,
        image: &str,
        from: String,
        request: &ContainerRequest,
        to: &Path,
    ) -> Result<(), StartError> {
        let through = request.project.instance.path().join("copied");
        let copy = ImageExport { name: &lease.name, image, from, through, to, size: self.config.project_size };
        copy.run(&self.docker).await
    }

    /// Writes the compose project, and creates the containers with compose.
    async fn make(
        &self,
        request: ContainerRequest,
        recipe: BuildPlan,
        lease: ProjectGuard,
        (image, controller): (String, Option<String>),
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<SimulationContainers, StartError> {
        let is_projects = recipe.dockerfile.is_some() || controller.is_some();
        let engine = self.engine.get_or_try_init(|| DockerFeatures::ask(&self.docker)).await?;
        let (config, templates) = (Arc::clone(&self.config), self.templates.clone());
        let (name, engine, asks) = (lease.name.clone(), engine.clone(), recipe.asks.clone());
        let files = move || {
            let world = world_in(&request.project)?;
            if matches!(asks.kind, ProjectKind::Competition { .. }) {
                let opened = build_plan::open_participant(&request.project.folder().join(&world));
                opened.map_err(|error| not_changed(&error))?;
            }
            let edited = edited_folder(&asks.kind, &request.project)?;
            let command = command(&config, &request, &world);
            let project = project_folder(&request.project)?;
            let parts = ComposeProject {
                name: &name,
                instance: request.project.instance.path(),
                project: &project,
                edited,
                volume: volume_of(&asks.kind),
                image: &image,
                controller: controller.as_deref(),
                command: &command,
                port: request.port,
                gpu: request.gpu.as_ref(),
                make: recipe.make,
                engine: &engine,
            };
            let template = templates.compose(&asks.kind).map_err(StartError::Server)?;
            let (options, variables) = parts.write(&template, &config)?;
            Ok::<_, StartError>((options, variables, template.services.into_keys()))
        };
        let (options, variables, services) = blocking(files).await?;
        // More concurrent runs would only be slower.
        let turn = self.turns.acquire().await.map_err(|error| StartError::Server(error.to_string()))?;
        progress(steps::CREATING.to_owned());
        let up = ["up", "--no-start", "--no-build"].map(str::to_owned);
        let words = options.into_iter().chain(up).map(Into::into).collect();
        let made = self.docker.compose(words, variables, SHORT).await;
        made.map_err(|error| blame(is_projects, error))?;
        drop(turn);
        // An editor has a port of its own, which the relay of streams does not reach.
        let has_editor = recipe.asks.kind != ProjectKind::Default && self.config.ports_are_public();
        let editor = has_editor.then(|| "ide: enable".to_owned());
        let texts = editor.into_iter().chain(recipe.asks.project_type).collect();
        let containers = services.map(|service| {
            let container = container_of(&lease.name, &service);
            (service, container)
        });
        let containers = containers.collect();
        Ok(SimulationContainers::new(self.docker.clone(), lease, containers, is_projects, texts, recipe.warnings))
    }
}

/// Why a competition's world can't be changed. An image may contain one that is not text, or with any mode.
fn not_changed(error: &io::Error) -> StartError {
    let why = format!("The world can't be changed: {error}");
    match error.kind() {
        io::ErrorKind::InvalidData | io::ErrorKind::PermissionDenied => StartError::Project(why),
        _ => StartError::Server(why),
    }
}
