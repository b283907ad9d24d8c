//! How a session starts its simulation: a slot, the checkout, Webots; and how a failed start ends.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use actix::prelude::*;
use actix_rt::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use super::session::{LaunchedSimulation, Session, State, WebotsHandle};
use crate::shared::domain::{Blame, Failure, ProjectUrl, Reason, ReservationId, View};
use crate::shared::http::Peer;
use crate::simulation::checkout::{Project, Tip};
use crate::simulation::isolation::RepositoryAssets;
use crate::simulation::machine::sensors::Gpu;
use crate::simulation::process::own_call_failed;
use crate::simulation::progress::{Progress, Step};
use crate::simulation::protocol::{self, Start};
use crate::simulation::readiness;
use crate::simulation::slots::{Prepared, Slot};
use crate::simulation::snapshot::SceneKind;
use crate::simulation::state::AppState;
use crate::simulation::webots::{LaunchSpec, Release, Webots, WebotsEvent};

/// A project that was checked out, and what the server has for it.
pub(super) struct CheckedOut {
    project: Project,
    /// Webots.
    program: PathBuf,
    release: Option<Release>,
    assets: Option<Arc<RepositoryAssets>>,
}

impl Session {
    /// Checks whether a client may request a simulation. Returns the slot that is reserved for it, if it has a pass.
    ///
    /// # Errors
    /// Why it may not.
    pub(super) fn admit(
        server: &AppState,
        peer: Peer,
        request: &Start,
    ) -> Result<(ProjectUrl, Option<ReservationId>), Failure> {
        let admitted = if server.start_quota.take(peer.rate_limit_key()) {
            server.admit(&request.url, request.pass.as_deref())
        } else {
            let message = "Too many simulations were asked for from your address. Try again in a minute";
            Err(Failure::new(Reason::TooManyRequests, message))
        };
        admitted.inspect_err(|failure| {
            count(server, failure.reason.code());
            log::info!("client {peer}: {failure} ({})", failure.reason);
        })
    }

    /// Counts a request for a simulation, for `/metrics`.
    pub(super) fn count(&self, outcome: &str) {
        count(&self.server, outcome);
    }

    /// Ends a start that has failed. A client's start that fails because of this server is reported to session servers,
    /// unless the simulation has ended meanwhile.
    pub(super) fn fail(&mut self, failure: Failure, ctx: &mut Context<Self>) {
        if let State::Over(_) = self.state {
            return;
        }
        if failure.reason.blame() == Blame::Server && self.has_client() {
            self.server
                .failed_starts
                .add(&format!("{}: {failure} ({})", self.name(), failure.reason));
        }
        if let State::CheckingOut { slot, .. } = &self.state {
            slot.end(failure.clone());
        }
        self.finish(failure, ctx);
    }

    /// Checks the project out for this slot. The checkout is cancelled when the state that this sets is dropped.
    pub(super) fn check_out(&mut self, world: ProjectUrl, tip: Option<Tip>, slot: Slot, ctx: &mut Context<Self>) {
        let cancelled = CancellationToken::new();
        self.state = State::CheckingOut {
            slot,
            progress: None,
            _checkout: cancelled.clone().drop_guard(),
        };
        let me = ctx.address();
        // A full mailbox drops this line of progress.
        let progress = move |progress| drop(me.try_send(WebotsEvent::Progress(progress)));
        let server = Arc::clone(&self.server);
        let checkout = async move {
            let run = Arc::clone(&server.run);
            let instance = spawn_blocking(move || run.instance())
                .await
                .map_err(|error| broke_off(&error))?;
            let instance = instance.map_err(|error| own_call_failed(&error))?;
            let job = server.checkouts.start(world, tip, instance, Arc::new(progress));
            let project = job.await.unwrap_or_else(|error| Err(broke_off(&error)))?;
            let checked_out = spawn_blocking(move || CheckedOut::new(&server, project)).await;
            checked_out.unwrap_or_else(|error| Err(broke_off(&error)))
        };
        cancelled
            .run_until_cancelled_owned(checkout)
            .into_actor(self)
            .map(|result, this, ctx| match result {
                Some(Ok(checked_out)) => this.launch(checked_out, ctx),
                Some(Err(failure)) => this.fail(failure, ctx),
                // The simulation has ended meanwhile.
                None => {}
            })
            .spawn(ctx);
    }

    fn launch(&mut self, checked_out: CheckedOut, ctx: &mut Context<Self>) {
        let CheckedOut {
            project,
            program,
            release,
            assets,
        } = checked_out;
        let slot = match std::mem::replace(&mut self.state, State::lost()) {
            State::CheckingOut { slot, .. } => slot,
            // It has ended meanwhile.
            other => return self.state = other,
        };
        log::info!(
            "{}: {} is for Webots {}",
            self.name(),
            project.world.path.display(),
            project.world.version
        );
        let version = project.world.version.clone();
        let scene = (self.view != View::Mjpeg).then(|| SceneKind::of(release));
        let gpu = self.take_gpu();
        slot.prepared(Prepared {
            version,
            scene,
            gpu: gpu.as_ref().map(|gpu| gpu.index),
        });
        if let Some(gpu) = &gpu {
            let event = format!("it gets GPU {}, {}", gpu.index, gpu.name);
            slot.log(log::Level::Info, &event, &event);
        }
        let progress = protocol::progress(&Progress::new(Step::Launch, "webots is starting"));
        self.texts(progress.clone());
        let project = Arc::new(project);
        let project_of_webots = Arc::downgrade(&project);
        let spec = LaunchSpec {
            config: Arc::clone(&self.server.config),
            containers: self.server.containers.clone(),
            launcher: Arc::clone(&self.server.launcher),
            disk_monitor: self.server.disk_monitor.clone(),
            program,
            assets,
            project,
            release,
            view: self.view,
            gpu,
            slot,
            address: self.peer().and_then(Peer::rate_limit_key),
            events: ctx.address().recipient(),
        };
        let thread = self.server.webots_thread(spec.slot.port);
        let has_client = self.has_client();
        let webots = Webots::start_in_arbiter(thread, move |ctx| Webots::create(spec, has_client, ctx));
        self.state = State::Launching {
            launched: LaunchedSimulation {
                webots: WebotsHandle(webots),
                project: project_of_webots,
                scene,
                texts: Vec::new(),
                started: None,
                is_resetting: false,
            },
            progress,
        };
    }

    /// Assigns a GPU to a simulation, if simulations are spread over GPUs and one answers.
    fn take_gpu(&self) -> Option<Gpu> {
        let spread = self.server.spread.as_ref()?;
        spread.take(&self.server.readings.borrow().gpus, Instant::now())
    }
}

impl CheckedOut {
    /// Reads from the disk what a launch needs besides the project. Blocks.
    fn new(server: &AppState, project: Project) -> Result<Self, Failure> {
        let program = readiness::webots_program(&server.config);
        let program = program.map_err(|why| Failure::new(Reason::LaunchFailed, why))?;
        Ok(Self {
            release: Release::of_simulation(&program, &project.world.version),
            assets: server.launcher.assets_of(&project.repository()),
            program,
            project,
        })
    }
}

/// A task of a checkout has panicked.
fn broke_off(error: &actix_rt::task::JoinError) -> Failure {
    Failure::new(Reason::ServerFault, format!("The checkout broke off: {error}"))
}

fn count(server: &AppState, outcome: &str) {
    server.starts.with_label_values(&[outcome]).inc();
}
