//! The launch specification: everything that one Webots is started with.

use std::io::ErrorKind;
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;

use super::command::webots_command;
use super::event::WebotsEvent;
use crate::simulation::checkout::{CheckoutService, Project};
use crate::simulation::config::SimulationConfig;
use crate::simulation::container::{ContainerRequest, ContainerService};
use crate::simulation::isolation::{Cgroup, DiskUse, Display, Launcher, Peak, Program, Watch, Watcher};
use crate::simulation::machine::display;
use crate::simulation::machine::sensors::Gpu;
use crate::simulation::process::{SpawnSpec, until_answering};
use crate::simulation::protocol::Mode;
use crate::simulation::slots::Slot;

/// A port that does not even refuse a connection for so long has a program that does not take it.
const SILENCE: Duration = Duration::from_millis(100);

/// Everything that one Webots is started with.
pub struct LaunchSpec {
    /// The server's configuration.
    pub config: Arc<SimulationConfig>,
    /// Creates its containers; `None` if it does not run in containers.
    pub containers: Option<Arc<ContainerService>>,
    /// Launches simulations.
    pub launcher: Arc<Launcher>,
    /// Monitors its limits.
    pub watcher: Watcher,
    /// The program to start.
    pub program: PathBuf,
    /// Restores controllers.
    pub checkouts: Arc<CheckoutService>,
    /// The project that was checked out.
    pub project: Arc<Project>,
    /// How it is shown.
    pub mode: Mode,
    /// The GPU that it was given, if one was.
    pub gpu: Option<Gpu>,
    /// The slot, with its port.
    pub slot: Slot,
    /// Receives the events.
    pub events: Recipient<WebotsEvent>,
}

impl LaunchSpec {
    /// The request for its containers.
    pub fn request(&self) -> ContainerRequest {
        let (program, heartbeat) = (Path::new(&self.config.container.program), self.config.timing.heartbeat);
        let mut command = webots_command(program, self.mode, self.slot.port, heartbeat, Path::new(""));
        // The path of the world in its container is known once its image is.
        command.pop();
        let command = command.into_iter().map(|word| word.to_string_lossy().into_owned()).collect();
        ContainerRequest { project: Arc::clone(&self.project), port: self.slot.port, gpu: self.gpu.clone(), command }
    }

    /// The display of the machine on which it opens its window.
    pub fn display(&self) -> String {
        self.config.display_on(self.gpu.as_ref().map(|gpu| gpu.index))
    }

    /// How the process is started and ended, and its control group.
    ///
    /// # Errors
    /// When a folder that it needs can't be made.
    pub fn spawn_spec(&self, display: &Display) -> std::io::Result<(SpawnSpec, Option<Cgroup>)> {
        let (heartbeat, world) = (self.config.timing.heartbeat, &self.project.world.path);
        let gpu = self.gpu.iter().map(|gpu| ("CUDA_VISIBLE_DEVICES".into(), gpu.id.clone().into()));
        self.launcher.prepare(Program {
            command: webots_command(&self.program, self.mode, self.slot.port, heartbeat, world),
            instance: self.project.instance.path(),
            project: self.project.instance.project(),
            folder: &self.project.folder,
            port: self.slot.port,
            display,
            variables: gpu.collect(),
            grace: self.config.timing.grace,
        })
    }

    /// Waits until the simulation with this root process exceeds a limit, and returns the message for its client.
    /// `peak` records its usage.
    pub fn until_too_much(&self, root: i32, peak: Option<Arc<Peak>>) -> impl Future<Output = String> + use<> {
        let (folder, limit) = (self.project.instance.path().to_owned(), self.config.limits.disk);
        let watch = Watch {
            disk: DiskUse::new(root, folder, self.project.size, limit),
            processes: self.launcher.most_processes(),
            runners: self.launcher.runners(),
            peak,
        };
        let watcher = self.watcher.clone();
        async move { watcher.until_too_much(watch).await }
    }

    /// Hints for the client of a Webots that did not become ready, about its isolation and its display.
    pub fn hint(&self) -> impl Future<Output = String> + use<> {
        let remark = self.launcher.remark();
        let has_own_display = self.config.xvfb || self.containers.is_some();
        let display = self.display();
        async move {
            if has_own_display {
                return remark.to_owned();
            }
            let fault = actix_rt::task::spawn_blocking(move || display::check(&display).err()).await;
            fault.ok().flatten().map_or_else(|| remark.to_owned(), |fault| format!("{remark} Note: {fault}."))
        }
    }

    /// Where this server reaches it.
    fn address(&self) -> SocketAddr {
        let address = self.launcher.reached().unwrap_or_else(|| self.config.address_of_simulations());
        (address, self.slot.port).into()
    }

    /// Whether another program listens there. It is not bound to find out: a process that is just being started elsewhere
    /// would inherit that.
    pub fn is_port_taken(&self) -> bool {
        let connected = TcpStream::connect_timeout(&self.address(), SILENCE);
        connected.map_or_else(|error| error.kind() == ErrorKind::TimedOut, |_| true)
    }

    /// Waits until it is ready at its port.
    pub fn until_ready(&self) -> impl Future<Output = ()> + use<> {
        let is_forwarded = self.containers.is_some() || self.launcher.reached().is_some();
        until_answering(self.address(), is_forwarded)
    }
}
