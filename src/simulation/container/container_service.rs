//! Creates the containers of simulations; one for the whole server.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use tokio::sync::{OnceCell, Semaphore};
use tokio_util::task::AbortOnDropHandle;

use super::build_plan::{self, BuildPlan, PROJECT_PATH};
use super::built_image::BuiltImage;
use super::compose_project::{ComposeProject, container_of};
use super::container_request::ContainerRequest;
use super::docker::Docker;
use super::docker_features::DockerFeatures;
use super::dockerfile::Dockerfile;
use super::image::{ImageBuild, Images};
use super::image_export::export;
use super::network;
use super::orphan_cleanup::{ActiveProjects, ProjectGuard, run_cleanup};
use super::owned_resources::{self, ResourceOwner};
use super::packet_filter;
use super::project_paths::{mounts, participant_folder, world_in};
use super::simulation_containers::SimulationContainers;
use super::start_error::{StartError, blame};
use super::steps;
use super::templates::Templates;
use super::webots_yml::ProjectKind;
use crate::simulation::checkout::OnProgress;
use crate::simulation::config::SimulationConfig;

/// Creates the containers of simulations.
#[derive(Debug)]
pub struct ContainerService {
    docker: Docker,
    owner: ResourceOwner,
    run: ResourceOwner,
    templates: Templates,
    images: Arc<Images>,
    active: ActiveProjects,
    features: OnceCell<DockerFeatures>,
    shortcoming: Option<String>,
    /// Limits concurrent runs of compose.
    turns: Semaphore,
    config: Arc<SimulationConfig>,
    _keeper: AbortOnDropHandle<()>,
}

/// Timeout of the creation of a simulation's containers: the disk of Docker may be busy with images of others.
const CREATE_TIMEOUT: Duration = Duration::from_mins(2);

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
        let (images, active) = (Arc::new(images), ActiveProjects::default());
        let keeper =
            run_cleanup(docker.clone(), owner.clone(), active.clone(), Arc::clone(&images), Arc::clone(&config));
        let keeper = AbortOnDropHandle::new(actix_rt::spawn(keeper));
        Ok(Self {
            docker,
            owner,
            run: this_run,
            templates,
            images,
            active,
            features: OnceCell::new(),
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
        progress: OnProgress<'_>,
    ) -> Result<SimulationContainers, StartError> {
        let (project, docker, size) = (&request.project, &self.docker, self.config.project_size);
        let (folder, templates, owner) = (project.folder().to_owned(), self.templates.clone(), self.owner.clone());
        let plan = spawn_blocking(move || BuildPlan::read(&folder, &templates, owner.name())).await??;
        let guard = self.active.insert(self.run.project(request.port));
        let network = self.config.container.network.name();
        network::join(docker, network).await?;
        let base = build_plan::image_of(&self.config.container.image, &project.world.version);
        let build = |dockerfile: &Dockerfile, folder| ImageBuild {
            project: Arc::clone(project),
            base: base.clone(),
            dockerfile: dockerfile.clone(),
            folder,
            has_makefile: plan.has_makefile,
            network,
        };
        let image = self.images.build(build(&plan.dockerfile, plan.has_project.then_some("")), progress).await?;
        if plan.has_project {
            let from = Path::new(PROJECT_PATH);
            export(docker, &guard.name, (&image.name, from), project, project.folder(), size).await?;
        }
        let mut controller = None;
        if let Some(dockerfile) = &plan.controller {
            let image = self.images.build(build(dockerfile, Some("controllers")), progress).await?;
            let (from, to) = (Path::new(PROJECT_PATH).join(plan.yml.folder_in_project()), participant_folder(project));
            export(docker, &guard.name, (&image.name, &from), project, &to, size).await?;
            controller = Some(image);
        }
        if plan.yml.kind != ProjectKind::Default {
            self.images.pull(&self.config.container.editor_image, progress).await?;
        }
        self.create(request, plan, guard, (image, controller), progress).await
    }

    /// Writes the compose project, and creates the containers with compose.
    async fn create(
        &self,
        request: ContainerRequest,
        plan: BuildPlan,
        guard: ProjectGuard,
        (image, controller): (BuiltImage, Option<BuiltImage>),
        progress: OnProgress<'_>,
    ) -> Result<SimulationContainers, StartError> {
        let is_projects = plan.has_project || controller.is_some();
        let features = self.features.get_or_try_init(|| DockerFeatures::query(&self.docker)).await?.clone();
        let (config, templates) = (Arc::clone(&self.config), self.templates.clone());
        let (name, yml, has_makefile) = (guard.name.clone(), plan.yml.clone(), plan.has_makefile);
        let files = move || {
            let world = world_in(&request.project)?;
            if yml.kind == ProjectKind::Competition {
                build_plan::open_participant(&request.project.folder().join(&world))?;
            }
            let (project, edited) = mounts(&yml, &request.project)?;
            let parts = ComposeProject {
                name: &name,
                instance: request.project.instance.path(),
                project: &project,
                edited: &edited,
                volume: &yml.folder,
                image: &image,
                controller: controller.as_ref(),
                command: &request.command(&config, &world),
                port: request.port,
                gpu: request.gpu.as_ref(),
                has_makefile,
                features: &features,
            };
            let template = templates.compose(yml.kind).map_err(StartError::Server)?;
            let (options, variables) = parts.write(&template, &config)?;
            Ok::<_, StartError>((options, variables, template.services))
        };
        let (options, variables, services) = spawn_blocking(files).await??;
        // More concurrent runs would only be slower.
        let turn = self.turns.acquire().await.map_err(|error| StartError::Server(error.to_string()))?;
        progress(steps::CREATING.to_owned());
        let words = options.into_iter().map(Into::into).chain(["up", "--no-start", "--no-build"].map(Into::into));
        let created = self.docker.compose(words.collect(), variables, CREATE_TIMEOUT).await;
        created.map_err(|error| blame(is_projects, error))?;
        drop(turn);
        // An editor has a port of its own, which the relay of streams does not reach.
        let has_editor = plan.yml.kind != ProjectKind::Default && self.config.ports_are_public();
        let texts = has_editor.then(|| "ide: enable".to_owned()).into_iter().chain(plan.yml.project_type).collect();
        let containers = services.into_keys().map(|service| (service.clone(), container_of(&guard.name, &service)));
        let (docker, containers, warnings) = (self.docker.clone(), containers.collect(), plan.yml.warnings);
        Ok(SimulationContainers { docker, guard, containers, is_projects, texts, warnings, restart: None })
    }
}
