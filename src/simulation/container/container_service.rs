//! Creates the containers of simulations; one for the whole server.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use actix_rt::task::spawn_blocking;
use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use super::build_plan::{BuildPlan, ImageBuild, PROJECT_PATH};
use super::compose_project::ComposeProject;
use super::container_request::ContainerRequest;
use super::docker::Docker;
use super::image::Images;
use super::image_export::export;
use super::network;
use super::orphan_cleanup::{ActiveProjects, run_cleanup};
use super::owned_resources::{ResourceOwner, sweep_all};
use super::packet_filter;
use super::project_paths::participant_folder;
use super::simulation_containers::SimulationContainers;
use super::start_error::{StartError, blame};
use super::steps;
use super::templates::Templates;
use super::webots_yml::ProjectKind;
use crate::simulation::checkout::OnProgress;
use crate::simulation::config::SimulationConfig;

/// Creates the containers of simulations.
pub struct ContainerService {
    docker: Docker,
    owner: ResourceOwner,
    /// The owner of these containers, for a process that removes them after the server's end.
    pub run: ResourceOwner,
    templates: Templates,
    images: Arc<Images>,
    active: ActiveProjects,
    /// What containers can do because the packet filter is missing; `None` if it is loaded.
    pub shortcoming: Option<String>,
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
        sweep_all(&owner);
        let this_run = owner.run();
        let shortcoming = packet_filter::missing();
        if let Some(why) = &shortcoming {
            log::warn!("{why}");
        }
        let templates = Templates::of(&config.container);
        templates.faults().iter().for_each(|fault| log::error!("{fault}"));
        let images = Images::new(docker.clone(), owner.clone(), Arc::clone(&config));
        let (images, active) = (Arc::new(images), ActiveProjects::default());
        let keeper = run_cleanup(owner.clone(), active.clone(), Arc::clone(&images), Arc::clone(&config));
        let keeper = AbortOnDropHandle::new(actix_rt::spawn(keeper));
        Ok(Self {
            docker,
            owner,
            run: this_run,
            templates,
            images,
            active,
            shortcoming,
            turns: Semaphore::new(2 * std::thread::available_parallelism().map_or(2, usize::from)),
            config,
            _keeper: keeper,
        })
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
        network::join(docker, self.config.container.network.name()).await?;
        let made = async |build: &ImageBuild, from: &Path, to: &Path| {
            let image = self.images.build(project, build, progress).await?;
            if build.folder.is_some() {
                export(docker, &guard.name, (&image.name, from), project, to, size).await?;
            }
            Ok::<_, StartError>(image)
        };
        let image = made(&plan.image, Path::new(PROJECT_PATH), project.folder()).await?;
        let mut controller = None;
        if let Some(build) = &plan.controller {
            let from = Path::new(PROJECT_PATH).join(plan.yml.folder_in_project());
            controller = Some(made(build, &from, &participant_folder(project)).await?);
        }
        if plan.yml.kind != ProjectKind::Default {
            self.images.pull(&self.config.container.editor_image, progress).await?;
        }
        let is_projects = plan.image.folder.is_some() || controller.is_some();
        let (yml, services) = (plan.yml.clone(), plan.template.services.clone());
        let (name, config) = (guard.name.clone(), Arc::clone(&self.config));
        let compose = ComposeProject { name, request, plan, image, controller, config };
        let (options, variables) = spawn_blocking(move || compose.write()).await??;
        // More concurrent runs would only be slower.
        let turn = self.turns.acquire().await.map_err(|error| StartError::Server(error.to_string()))?;
        progress(steps::CREATING.to_owned());
        let up = ["up", "--no-start", "--no-build"].map(str::to_owned);
        let words = self.docker.compose.iter().map(|word| (*word).to_owned()).chain(options).chain(up);
        let created = self.docker.follow(words.map(Into::into).collect(), variables, CREATE_TIMEOUT, |_| ()).await;
        created.map_err(|error| blame(is_projects, error))?;
        drop(turn);
        // An editor has a port of its own, which the relay of streams does not reach.
        let has_editor = yml.kind != ProjectKind::Default && self.config.ports_are_public();
        let texts = has_editor.then(|| "ide: enable".to_owned()).into_iter().chain(yml.project_type).collect();
        let (docker, services, warnings) = (self.docker.clone(), services.into_keys().collect(), yml.warnings);
        Ok(SimulationContainers { docker, guard, services, is_projects, texts, warnings, restart: None })
    }
}
