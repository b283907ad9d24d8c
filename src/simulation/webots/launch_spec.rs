//! The launch specification: everything that one Webots is started with.

use std::ffi::OsString;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use actix::prelude::*;

use super::event::WebotsEvent;
use super::release::Release;
use super::startup::{ListenSign, StartupEvent, follow_startup};
use crate::shared::domain::View;
use crate::simulation::checkout::Project;
use crate::simulation::config::SimulationConfig;
use crate::simulation::container::{ContainerRequest, ContainerService};
use crate::simulation::isolation::{Cgroup, DiskMonitor, DiskUse, Display, Launcher, RepositoryAssets};
use crate::simulation::machine::sensors::Gpu;
use crate::simulation::process::SpawnSpec;
use crate::simulation::slots::Slot;

/// Everything that one Webots is started with.
pub struct LaunchSpec {
    /// The server's configuration.
    pub config: Arc<SimulationConfig>,
    /// Creates its containers; `None` if it does not run in containers.
    pub containers: Option<Arc<ContainerService>>,
    /// Launches simulations.
    pub launcher: Arc<Launcher>,
    /// Monitors its limits.
    pub disk_monitor: DiskMonitor,
    /// The program to start.
    pub program: PathBuf,
    /// The project that was checked out.
    pub project: Arc<Project>,
    /// What Webots has downloaded for its repository before, if that is kept.
    pub assets: Option<Arc<RepositoryAssets>>,
    /// The release of Webots that runs, if it is known.
    pub release: Option<Release>,
    /// How it is shown.
    pub view: View,
    /// The GPU assigned to it, if any.
    pub gpu: Option<Gpu>,
    /// The slot, with its port.
    pub slot: Slot,
    /// The address of its client, which has a share of the builders of images.
    pub address: Option<IpAddr>,
    /// Receives the events.
    pub events: Recipient<WebotsEvent>,
}

impl LaunchSpec {
    /// The request for its containers. The world's path in the container is added once the image is known.
    pub fn request(&self) -> ContainerRequest {
        let command = std::iter::once(self.config.container.program.clone())
            .chain(self.options())
            .collect();
        ContainerRequest {
            project: Arc::clone(&self.project),
            port: self.slot.port,
            gpu: self.gpu.clone(),
            address: self.address,
            command,
        }
    }

    /// The options of Webots, before its world.
    ///
    /// The 3D stream is requested as plain `--stream`: R2025a rejects `--stream=x3d`, R2023b rejects `--stream=w3d`.
    /// The MJPEG stream shows the window, which therefore must be neither minimized nor without rendering.
    fn options(&self) -> Vec<String> {
        let (window, stream): (&[_], _) = match self.view {
            View::Mjpeg => (&[], "--stream=mjpeg"),
            View::X3d => (&["--minimize", "--no-rendering"], "--stream"),
        };
        let mut options = [&["--batch", "--mode=pause"], window]
            .concat()
            .into_iter()
            .map(str::to_owned)
            .collect::<Vec<_>>();
        options.push(format!("--port={}", self.slot.port));
        options.push(format!("--heartbeat={}", self.config.timing.heartbeat.as_millis()));
        options.push(stream.to_owned());
        options
    }

    /// How the process is started and ended on the machine, and its control group.
    ///
    /// # Errors
    /// When there is no Xvfb, or a directory that it needs can't be created.
    pub fn spawn_spec(&self) -> std::io::Result<(SpawnSpec, Option<Cgroup>)> {
        let instance = self.project.instance.path();
        let display = if self.config.xvfb {
            Display::new_virtual(instance)?
        } else {
            Display::Outside(self.config.display_on(self.gpu.as_ref().map(|gpu| gpu.index)))
        };
        let mut command: Vec<OsString> = vec![self.program.clone().into()];
        command.extend(self.options().into_iter().map(Into::into));
        command.push(self.project.world.path.clone().into());
        let gpu = self
            .gpu
            .iter()
            .map(|gpu| ("CUDA_VISIBLE_DEVICES".into(), gpu.id.clone().into()));
        let spec = SpawnSpec {
            environment: gpu.collect(),
            folder: Some(self.project.folder.clone()),
            grace: self.config.timing.grace,
            ..SpawnSpec::new(command, instance)
        };
        self.launcher
            .prepare(spec, self.slot.port, &display, self.assets.as_deref())
    }

    /// Keeps what Webots has downloaded for the next simulations of its repository, on a thread of its own. Until then the
    /// instance's directory stays.
    pub fn keep_assets(&self) {
        if let Some(assets) = self.assets.clone() {
            let launcher = Arc::clone(&self.launcher);
            let instance = Arc::clone(&self.project.instance);
            actix_rt::task::spawn_blocking(move || launcher.keep_assets(&assets, instance.path()));
        }
    }

    /// Waits until the simulation with this root process exceeds a limit, and returns the message for its client.
    pub fn until_too_much(&self, root: i32) -> impl Future<Output = String> + use<> {
        let folder = self.project.instance.path().to_owned();
        let disk = DiskUse::new(root, folder, self.project.size, self.config.limits.disk);
        self.disk_monitor.clone().until_too_much(disk)
    }

    /// The address at which this server reaches it.
    fn address(&self) -> SocketAddr {
        let address = self
            .launcher
            .reached()
            .unwrap_or_else(|| self.config.address_of_simulations());
        (address, self.slot.port).into()
    }

    /// Whether its first heartbeat shows that it is ready, because its release does not answer before that.
    pub fn is_ready_by_heartbeat(&self) -> bool {
        !Release::answers_during_start(self.release)
    }

    /// Follows the start of this root process at its port, until it is ready.
    pub fn follow_startup(&self, root: i32, events: Recipient<StartupEvent>) -> impl Future<Output = ()> + use<> {
        let sign = if self.containers.is_some() {
            ListenSign::Answers
        } else if self.launcher.reached().is_some() {
            ListenSign::InNetworkOf(root)
        } else {
            ListenSign::Accepts
        };
        follow_startup(self.address(), sign, !self.is_ready_by_heartbeat(), events)
    }
}
