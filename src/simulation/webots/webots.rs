//! Actor: one running Webots. Owns its process group, its instance directory and its slot; ends with all three.
//!
//! Created by a session once its project is checked out. Starts Webots, waits until its world is ready, monitors its heartbeat
//! and the time limit, sends [`WebotsEvent`]s, and ends when Webots' whole process tree has ended. Never restarted.

use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use log::Level;
use tokio::sync::Notify;

use super::event::{WebotsEvent, WebotsExit};
use super::launch_spec::LaunchSpec;
use super::launched::{self, End};
use super::output::{OutputEvent, Tail};
use super::startup::StartupEvent;
use crate::simulation::container::{SimulationContainers, StartError};
use crate::simulation::ends::{EndReason, Taken};
use crate::simulation::process::ProcessGroup;
use crate::simulation::snapshot::Stage;

/// Requests Webots' end, because its client has left or for another reason.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Stop(pub EndReason);

/// The actor.
pub struct Webots {
    pub(super) spec: LaunchSpec,
    /// The preparation of its containers, while it runs.
    preparing: Option<SpawnHandle>,
    group: Option<ProcessGroup>,
    /// Restarts the controller of a competition's participant.
    restart: Option<Arc<Notify>>,
    /// Follows its start.
    startup: Option<SpawnHandle>,
    tail: Tail,
    /// Whether its world is ready.
    pub(super) listening: bool,
    /// Whether the simulation is not paused.
    pub(super) runs: bool,
    /// The wait until one that is paused ends, and whether its client was notified of that end.
    pub(super) idle_end: Option<(SpawnHandle, bool)>,
    last_heartbeat: Instant,
    hanging: bool,
    /// Why it was stopped, if it was.
    stopped_for: Option<(EndReason, String)>,
    /// How it has ended, if it has: its session is notified when this actor is dropped.
    exit: Option<WebotsExit>,
}

/// Number of missed heartbeats after which Webots counts as hanging.
const MISSED_HEARTBEATS: u32 = 6;

impl Webots {
    /// Creates the actor; Webots starts with it.
    pub fn new(spec: LaunchSpec) -> Self {
        Self {
            spec,
            preparing: None,
            group: None,
            restart: None,
            startup: None,
            tail: Tail::default(),
            listening: false,
            runs: false,
            idle_end: None,
            last_heartbeat: Instant::now(),
            hanging: false,
            stopped_for: None,
            exit: None,
        }
    }

    /// Prepares its containers, if it has any, then starts it. Dropping the preparation discards what was created.
    fn prepare(&mut self, ctx: &mut Context<Self>) {
        let Some(containers) = self.spec.containers.clone() else {
            return self.launch(None, ctx);
        };
        let (client, request) = (self.spec.events.clone(), self.spec.request());
        // A full mailbox drops this line.
        let progress = move |text| drop(client.try_send(WebotsEvent::Progress(text)));
        let prepared = async move {
            let mut prepared = containers.prepare(request, &progress).await?;
            prepared.start_others().await.map(|()| prepared)
        };
        self.preparing = Some(
            ctx.spawn(prepared.into_actor(self).map(|prepared, this, ctx| match prepared {
                Ok(containers) => this.launch(Some(containers), ctx),
                Err(StartError::Project(why)) => this.over(EndReason::NoWebots, &why, Taken::default(), ctx),
                Err(StartError::Server(why)) => this.over(EndReason::Fault, &why, Taken::default(), ctx),
            })),
        );
    }

    fn launch(&mut self, containers: Option<SimulationContainers>, ctx: &mut Context<Self>) {
        self.preparing = None;
        if let Some(containers) = &containers {
            self.restart = containers.restart();
            containers
                .warnings
                .iter()
                .cloned()
                .for_each(|warning| self.send(WebotsEvent::Progress(warning)));
            containers
                .texts
                .iter()
                .cloned()
                .for_each(|text| self.send(WebotsEvent::Text(text)));
        }
        if let Err(error) = self.spawn(containers, ctx) {
            let why = format!("Webots can't be started: {error}");
            return self.over(EndReason::Fault, &why, Taken::default(), ctx);
        }
        self.send(WebotsEvent::Started);
        // In containers, the wait begins when the container reports that it runs.
        self.spec.containers.is_none().then(|| self.follow_startup(ctx));
        ctx.run_interval(self.spec.config.timing.heartbeat, Self::check_heartbeat);
        let limit = self.spec.config.timing.launch;
        ctx.run_later(limit, move |this, _| {
            if !this.listening {
                let why = format!("Webots did not become ready within {} seconds", limit.as_secs());
                this.stop(EndReason::NoWebots, &why);
            }
        });
        let limit = self.spec.config.timeout;
        ctx.run_later(Duration::from_secs(limit), move |this, _| {
            this.stop(
                EndReason::TimeLimit,
                &format!("The time limit of {limit} seconds was reached"),
            );
        });
    }

    /// Starts the process, and calls [`Self::ended`] when it has ended.
    fn spawn(&mut self, containers: Option<SimulationContainers>, ctx: &mut Context<Self>) -> std::io::Result<()> {
        // Another program may have taken the port during the checkout, and would be mistaken for Webots.
        if self.spec.is_port_taken() {
            return Err(std::io::ErrorKind::AddrInUse.into());
        }
        let (group, tail, ended) = launched::launch(&self.spec, containers, ctx.address().recipient())?;
        let (program, world) = (self.spec.program.display(), self.spec.project.world.path.display());
        let pid = group.leader();
        self.log(Level::Info, &format!("started {program} for {world} (process {pid})"));
        (self.tail, self.group) = (tail, Some(group));
        ended
            .into_actor(self)
            .map(|end, this, ctx| this.ended(&end, ctx))
            .spawn(ctx);
        let excess = self.spec.until_too_much(pid).into_actor(self);
        excess.map(|why, this, _| this.stop(EndReason::Limit, &why)).spawn(ctx);
        Ok(())
    }

    /// Follows its start, unless that has begun or its heartbeat shows when it is ready.
    fn follow_startup(&mut self, ctx: &mut Context<Self>) {
        if self.startup.is_none() && !self.spec.is_ready_by_heartbeat() {
            let startup = self.spec.follow_startup(ctx.address().recipient());
            self.startup = Some(ctx.spawn(startup.into_actor(self)));
        }
    }

    fn ready(&mut self, ctx: &mut Context<Self>) {
        if self.stopped_for.is_some() || self.listening {
            return;
        }
        self.log(Level::Info, "ready");
        self.listening = true;
        self.last_heartbeat = Instant::now();
        self.show_pace();
        let stream = self.spec.slot.lease.open_stream();
        self.send(WebotsEvent::Listening(self.spec.slot.port, stream));
        self.used(ctx);
    }

    /// Shows whether the simulation runs, unless Webots is starting or ending.
    fn show_pace(&self) {
        if self.listening && self.stopped_for.is_none() {
            let stage = if self.runs { Stage::Running } else { Stage::Idle };
            self.spec.slot.lease.update(move |one| one.stage = stage);
        }
    }

    fn check_heartbeat(&mut self, _: &mut Context<Self>) {
        // Until its world is ready, the timeout of its launch applies: it sends no heartbeat while it reads the world.
        if !self.listening {
            return;
        }
        let silence = self.last_heartbeat.elapsed();
        let hangs_after = self.spec.config.timing.heartbeat * MISSED_HEARTBEATS;
        if silence > hangs_after + self.spec.config.hang_limit {
            self.stop(
                EndReason::Hung,
                &format!("Webots gave no sign of life for {} seconds", silence.as_secs()),
            );
        } else if silence > hangs_after && !self.hanging {
            self.hanging = true;
            self.log(Level::Warn, &format!("no sign of life for {} s", silence.as_secs()));
            self.send(WebotsEvent::Hanging(silence.as_secs()));
        }
    }

    /// Ends Webots: gracefully, or at once if it exceeds a limit, which it could exceed further in a grace period. Only
    /// the first reason counts.
    pub(super) fn stop(&mut self, kind: EndReason, why: &str) {
        if self.stopped_for.is_some() {
            return;
        }
        self.log(
            if kind == EndReason::Limit {
                Level::Warn
            } else {
                Level::Info
            },
            &format!("ending: {why}"),
        );
        self.stopped_for = Some((kind, why.to_owned()));
        if kind.is_intended() {
            self.spec.slot.lease.ending(why);
        }
        self.spec.slot.lease.update(|one| one.stage = Stage::Stopping);
        if kind == EndReason::Limit {
            self.group = None;
        } else {
            self.group.iter_mut().for_each(ProcessGroup::terminate);
        }
    }

    fn ended(&mut self, end: &End, ctx: &mut Context<Self>) {
        self.log(Level::Info, &format!("Webots {}", end.reason));
        let (kind, why) = self.stopped_for.take().unwrap_or_else(|| end.verdict(self.listening));
        self.over(kind, &why, end.taken, ctx);
    }

    /// Reports the end, and stops. If Webots has not become ready, that is this server's fault; in containers it is the
    /// project's, because the project determines what they run.
    fn over(&mut self, kind: EndReason, why: &str, taken: Taken, ctx: &mut Context<Self>) {
        self.spec.slot.lease.end(kind, why, taken);
        let clean = kind == EndReason::Finished;
        let own = kind == EndReason::Fault || !(clean || self.listening || self.spec.containers.is_some());
        let mut why = why.to_owned();
        if !clean {
            why += &self.tail.last_words(&self.spec.project.instance.project());
        }
        if kind == EndReason::NoWebots && self.group.is_some() {
            why += self.spec.launcher.remark();
        }
        if self.listening {
            self.spec.keep_assets();
        }
        self.exit = Some(WebotsExit { clean, own, why });
        ctx.stop();
    }

    pub(super) fn send(&self, event: WebotsEvent) {
        self.spec.events.do_send(event);
    }

    /// Logs an event with the port, and records it without: a client that has only a token must not learn the port.
    fn log(&self, level: Level, event: &str) {
        self.spec
            .slot
            .lease
            .log(level, &format!("port {}: {event}", self.spec.slot.port), event);
    }
}

impl Drop for Webots {
    /// Notifies the session of the end, even after a panic.
    fn drop(&mut self) {
        let why = "The server has lost this simulation".to_owned();
        let exit = self.exit.take().unwrap_or(WebotsExit {
            clean: false,
            own: true,
            why,
        });
        self.send(WebotsEvent::Exited(exit));
    }
}

impl Actor for Webots {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        self.prepare(ctx);
    }
}

impl Handler<OutputEvent> for Webots {
    type Result = ();

    fn handle(&mut self, event: OutputEvent, ctx: &mut Self::Context) {
        self.last_heartbeat = Instant::now();
        self.hanging = false;
        match event {
            OutputEvent::Heartbeat if self.listening => self.send(WebotsEvent::Heartbeat),
            OutputEvent::Heartbeat if self.spec.is_ready_by_heartbeat() => self.ready(ctx),
            OutputEvent::Heartbeat => {}
            OutputEvent::ContainerRuns => self.follow_startup(ctx),
            OutputEvent::Reset => {
                self.restart.iter().for_each(|controller| controller.notify_one());
                self.used(ctx);
            }
            OutputEvent::Paused | OutputEvent::Running => {
                self.runs = event == OutputEvent::Running;
                self.show_pace();
                self.used(ctx);
            }
        }
    }
}

impl Handler<StartupEvent> for Webots {
    type Result = ();

    fn handle(&mut self, event: StartupEvent, ctx: &mut Self::Context) {
        match event {
            StartupEvent::Listening => {}
            StartupEvent::Loading(progress) => self.send(WebotsEvent::Progress(progress)),
            StartupEvent::Ready => self.ready(ctx),
        }
    }
}

impl Handler<Stop> for Webots {
    type Result = ();

    fn handle(&mut self, Stop(kind): Stop, ctx: &mut Self::Context) {
        let why = match kind {
            EndReason::Stopped => "The server was stopped",
            EndReason::Administrator => "The administrator has stopped it",
            _ => "Its client has gone",
        };
        self.stop(kind, why);
        if let Some(preparing) = self.preparing.take() {
            ctx.cancel_future(preparing);
            self.over(kind, why, Taken::default(), ctx);
        }
    }
}
