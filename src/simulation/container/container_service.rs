//! Creates the containers of simulations; one for the whole server.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use tokio::runtime::Handle;
use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use super::build_plan::{BuildPlan, ImageBuild, PROJECT_PATH, participant_folder};
use super::built_image::export;
use super::compose_project::{ComposeProject, ContainerRequest, WEBOTS};
use super::docker::{Docker, SHORT_TIMEOUT, daemon_fault};
use super::failures::{of_project, on_thread, refused_by_docker};
use super::image::Images;
use super::image_store::ImageUse;
use super::network;
use super::owned_resources::{ProjectGuard, ResourceOwner, sweep_except};
use super::packet_filter;
use super::simulation_containers::SimulationContainers;
use super::webots_yml::ProjectKind;
use crate::shared::domain::{Failure, ProjectUrl};
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::process_tree::is_connected;
use crate::simulation::progress::{OnProgress, Progress, Step};
use crate::simulation::run_id::RunId;

/// Creates the containers of simulations.
pub struct ContainerService {
    docker: Docker,
    /// The owner of these containers, for a process that removes them after the server's end.
    pub run: ResourceOwner,
    images: Arc<Images>,
    /// Removes containers.
    runtime: Handle,
    /// What containers can do because the packet filter is missing; `None` if it is loaded.
    pub shortcoming: Option<String>,
    /// Limits concurrent runs of compose.
    turns: Semaphore,
    config: Arc<SimulationConfig>,
    _removes_old_images: AbortOnDropHandle<()>,
}

/// Timeout of the creation of a simulation's containers: the disk of Docker may be busy with images of others.
const CREATE_TIMEOUT: Duration = Duration::from_mins(2);

impl ContainerService {
    /// Opens the service on the current runtime. `run` is the directory of this run of the server. Removes what
    /// earlier runs have left, except those that live. Blocks for a moment.
    ///
    /// # Errors
    /// When Docker or compose is not installed, as text for an administrator.
    pub fn open(config: Arc<SimulationConfig>, run: &Path, living: &[RunId]) -> Result<Self, String> {
        let docker = Docker::find(run)?;
        let owner = ResourceOwner::of(&config.cache_dir.0);
        sweep_except(&owner, living);
        let shortcoming = packet_filter::missing();
        if let Some(why) = &shortcoming {
            log::warn!("{why}");
        }
        let images = Arc::new(Images::new(docker.clone(), owner.clone(), Arc::clone(&config)));
        let remover = AbortOnDropHandle::new(actix_rt::spawn(Arc::clone(&images.store).keep_within_limits()));
        Ok(Self {
            docker,
            run: owner.run(),
            images,
            runtime: Handle::current(),
            shortcoming,
            turns: Semaphore::new(2 * std::thread::available_parallelism().map_or(2, usize::from)),
            config,
            _removes_old_images: remover,
        })
    }

    /// Creates the containers of a simulation, but starts none. `progress` receives each step.
    ///
    /// Dropping the future discards everything that was created.
    ///
    /// # Errors
    /// Why they can't be created.
    pub async fn prepare(
        &self,
        request: ContainerRequest,
        progress: OnProgress<'_>,
    ) -> Result<SimulationContainers, Failure> {
        let project = &request.project;
        let address = request.address;
        let docker = &self.docker;
        let folder = project.folder.clone();
        let owner = self.images.owner.clone();
        let plan = on_thread(move || BuildPlan::read(&folder, &owner.0).map_err(of_project)).await?;
        let BuildPlan { yml, image, controller } = plan;
        let guard = ProjectGuard {
            name: self.run.project(request.port),
            runtime: self.runtime.clone(),
        };
        network::join(docker, self.config.container.network.name()).await?;
        let is_projects = image.folder.is_some() || controller.is_some();
        let mut kept = Vec::new();
        let mut made = async |build: ImageBuild, from: &Path, to: &Path| {
            let has_project = build.folder.is_some();
            let (image, uses) = self.images.build(project, build, address, progress).await?;
            kept.extend(uses);
            if has_project {
                export(&image, (docker, &self.config), &guard.name, from, project, to).await?;
            }
            Ok::<_, Failure>(image)
        };
        let image = made(image, Path::new(PROJECT_PATH), &project.folder).await?;
        let controller = match controller {
            Some(build) => {
                let from = Path::new(PROJECT_PATH).join(yml.folder_in_project());
                Some(made(build, &from, &participant_folder(project)).await?)
            }
            None => None,
        };
        let has_editor = yml.kind != ProjectKind::Default;
        if has_editor {
            kept.push(self.images.store.keep(&self.config.container.editor_image));
            self.images
                .pull(&self.config.container.editor_image, address, progress)
                .await?;
        }
        // It has no client: it is kept ready.
        if address.is_none() {
            self.images.store.used_for(&project.url, &kept);
        }
        let compose = ComposeProject {
            name: guard.name.clone(),
            request,
            yml,
            image,
            controller,
            config: Arc::clone(&self.config),
        };
        let written = on_thread(move || compose.write().map(|written| (written, compose.yml))).await?;
        let ((options, services), yml) = written;
        // More concurrent runs would only be slower. The semaphore is never closed.
        let turn = self.turns.acquire().await.ok();
        progress(Progress::new(Step::Launch, "Creating network and containers"));
        let up = ["up", "--no-start", "--no-build"].map(str::to_owned);
        let words = self
            .docker
            .compose
            .iter()
            .map(|word| (*word).to_owned())
            .chain(options)
            .chain(up);
        let created = self
            .docker
            .follow(words.map(Into::into).collect(), CREATE_TIMEOUT, |_| ())
            .await;
        if let Err(error) = created {
            let otherwise = error.unless_slow(refused_by_docker(is_projects));
            return Err(docker.explain(error, self.config.disk_reserve, otherwise).await);
        }
        drop(turn);
        // From now on its containers keep them.
        drop(kept);
        // An editor has a port of its own, which the relay of streams does not reach.
        let ide = (has_editor && self.config.ports_are_public()).then(|| "ide: enable".to_owned());
        let texts = ide.into_iter().chain(yml.project_type).collect();
        Ok(SimulationContainers {
            docker: self.docker.clone(),
            reserve: self.config.disk_reserve,
            guard,
            services,
            is_projects,
            texts,
            warnings: yml.warnings,
            restart: None,
        })
    }

    /// Keeps the images that the last simulation of a world that is kept ready has had, until the returned values are dropped.
    pub fn keep_images_of(&self, world: &ProjectUrl) -> Vec<ImageUse> {
        self.images.store.keep_for(world)
    }

    /// Whether a connection to the Webots of the simulation on this port is open; `None` if that is not known. The kernel
    /// of the container tells: Docker may run in another namespace of processes, and forward without a process.
    pub async fn has_connection(&self, port: u16) -> Option<bool> {
        let name = format!("name=^{}", self.run.prefix_of(port));
        let service = format!("label=com.docker.compose.service={WEBOTS}");
        let list = ["ps", "--quiet", "--filter", &name, "--filter", &service];
        let ids = self.docker.run(&list, SHORT_TIMEOUT).await.ok()?;
        let tables = ["exec", ids.trim(), "cat", "/proc/net/tcp", "/proc/net/tcp6"];
        let tables = self.docker.run(&tables, SHORT_TIMEOUT).await.ok()?;
        is_connected(&tables, port)
    }
}

/// Checks whether simulations can run in containers. Blocks for some seconds at most.
///
/// # Errors
/// What is missing, as text for an administrator.
pub fn check(config: &SimulationConfig) -> Result<String, String> {
    Docker::find(Path::new("/"))?;
    daemon_fault().map_or(Ok(()), |failure| Err(failure.in_full()))?;
    network::check(config.container.network.name())?;
    packet_filter::missing().map_or(Ok(()), Err)?;
    Ok(format!(
        "it answers; worlds run in {}, or the image of their project's Dockerfile",
        config.container.image
    ))
}
