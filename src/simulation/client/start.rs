//! How a session starts its simulation: a slot, the checkout, Webots; and how a failed start ends.

use std::sync::Arc;
use std::time::Instant;

use actix::prelude::*;
use actix_web_actors::ws::CloseCode;

use super::session::{Session, State, WebotsHandle};
use crate::shared::domain::ProjectUrl;
use crate::simulation::checkout::Project;
use crate::simulation::client_identity::ClientIdentity;
use crate::simulation::ends::EndReason;
use crate::simulation::machine::sensors::Gpu;
use crate::simulation::protocol::{self, Mode, SceneKind};
use crate::simulation::readiness;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::slots::{Slot, SlotLease};
use crate::simulation::webots::{LaunchSpec, Release, Webots, WebotsEvent};

impl Session {
    /// Counts a request for a simulation, for `/metrics`.
    pub(super) fn count(&self, outcome: &str) {
        self.server.starts.with_label_values(&[outcome]).inc();
    }

    /// Sends the client the reason, and ends.
    pub(super) fn give_up(&mut self, why: &str, ctx: &mut Context<Self>) {
        log::info!("{}: {why}", self.name());
        self.finish(protocol::error(why), why, CloseCode::Normal, ctx);
    }

    /// Like `give_up`, for a client that another server may accept: the close code tells programs so.
    pub(super) fn refer(&mut self, why: &str, ctx: &mut Context<Self>) {
        log::info!("{}: {why}", self.name());
        self.finish(protocol::elsewhere(why), why, CloseCode::Again, ctx);
    }

    /// Like `refer`, for a start that fails because of this server, which is reported to session servers.
    pub(super) fn fail_own(&mut self, why: &str, ctx: &mut Context<Self>) {
        self.server.failed_starts.add(&format!("{}: {why}", self.name()));
        self.end(EndReason::Fault, why);
        self.refer(why, ctx);
    }

    pub(super) fn request_slot(&mut self, url: &str, identity: ClientIdentity, ctx: &mut Context<Self>) {
        let admitted = if self.server.start_quota.take(self.peer.rate_limit_key()) {
            self.server.admit(url)
        } else {
            Err("Too many simulations were asked for from your address. Try again in a minute".to_owned())
        };
        let world = match admitted {
            Ok(world) => world,
            Err(why) => {
                self.count("refused");
                return if self.server.takes_nobody() {
                    self.refer(&why, ctx);
                } else {
                    self.give_up(&why, ctx);
                };
            }
        };
        let id = SimulationId::next();
        self.id = Some(id);
        self.text(protocol::session(id));
        log::info!("{}: asks for {world}{identity}", self.name());
        let (me, client) = (ctx.address().recipient(), (self.peer, identity));
        match SlotLease::acquire(&self.server.slots, id, me, &world, client) {
            Ok(lease) => self.state = State::Waiting { world, lease },
            Err(why) => {
                self.count("full");
                self.give_up(&why, ctx);
            }
        }
    }

    pub(super) fn check_out(&mut self, world: ProjectUrl, slot: Slot, ctx: &mut Context<Self>) {
        self.state = State::CheckingOut(slot);
        let instance = match self.server.run.instance() {
            Ok(instance) => instance,
            Err(error) => return self.fail_own(&format!("No room for a project: {error}"), ctx),
        };
        let me = ctx.address();
        // A full mailbox drops this line of progress.
        let progress = move |text: String| drop(me.try_send(WebotsEvent::Progress(text)));
        let job = self.server.checkouts.start(world, instance, Arc::new(progress));
        job.into_actor(self)
            .map(|result, this, ctx| match result {
                Ok(Ok(project)) => this.launch(project, ctx),
                Ok(Err(error)) if error.is_own() => this.fail_own(&error.to_string(), ctx),
                Ok(Err(error)) => {
                    let why = error.to_string();
                    this.end(EndReason::NoCheckout, &why);
                    this.give_up(&why, ctx);
                }
                Err(error) => this.fail_own(&format!("The checkout broke off: {error}"), ctx),
            })
            .spawn(ctx);
    }

    pub(super) fn launch(&mut self, project: Project, ctx: &mut Context<Self>) {
        let program = match readiness::webots_program(&self.server.config) {
            Ok(program) => program,
            Err(why) => return self.fail_own(&why, ctx),
        };
        let State::CheckingOut(slot) = std::mem::replace(&mut self.state, State::Over) else {
            return;
        };
        log::info!(
            "{}: {} is for Webots {}",
            self.name(),
            project.world.path.display(),
            project.world.version
        );
        let version = project.world.version.clone();
        slot.lease.update(|one| one.version = Some(version));
        let release = Release::of_simulation(&program, &project.world.version);
        self.kind = (self.mode != Mode::Mjpeg).then(|| SceneKind::of(release));
        self.text(protocol::loading("webots is starting"));
        let gpu = self.take_gpu(&slot.lease);
        let project = Arc::new(project);
        self.project = Arc::downgrade(&project);
        let spec = LaunchSpec {
            config: Arc::clone(&self.server.config),
            containers: self.server.containers.clone(),
            launcher: Arc::clone(&self.server.launcher),
            watcher: self.server.watcher.clone(),
            program,
            assets: self.server.launcher.assets_of(&project.repository()),
            project,
            release,
            mode: self.mode,
            gpu,
            slot,
            events: ctx.address().recipient(),
        };
        let webots = Webots::start_in_arbiter(self.server.webots_thread(spec.slot.port), |_| Webots::new(spec));
        self.state = State::Launched(WebotsHandle(webots));
    }

    /// Assigns a GPU to a simulation, if simulations are spread over GPUs and one answers.
    fn take_gpu(&self, lease: &SlotLease) -> Option<Gpu> {
        let spread = self.server.spread.as_ref()?;
        let gpu = spread.take(&self.server.readings.borrow().gpus, Instant::now())?;
        let event = format!("it gets GPU {}, {}", gpu.index, gpu.name);
        lease.update(|one| one.gpu = Some(gpu.index));
        lease.log(log::Level::Info, &event, &event);
        Some(gpu)
    }
}
