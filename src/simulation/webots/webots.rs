//! Actor: one running Webots. Owns its process group, its instance directory and its slot; ends with all three.
//!
//! Created by a session once its project is checked out. Starts Webots, waits until its world is ready, monitors its
//! heartbeat and the time limit, sends [`WebotsEvent`]s, and ends when Webots' whole process tree has ended. Never restarted.

use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::fut::wrap_future;
use actix::prelude::*;
use log::Level;
use tokio::sync::Notify;

use super::event::WebotsEvent;
use super::launch_spec::LaunchSpec;
use super::launched::{self, Exit, LaunchedProcess, Reached};
use super::output::{OutputEvent, Tail};
use super::startup::StartupEvent;
use crate::shared::domain::{Blame, Failure, Reason};
use crate::simulation::container::SimulationContainers;
use crate::simulation::ends::{End, StopReason, lost};
use crate::simulation::process::ProcessGroup;
use crate::simulation::progress::{Progress, Step};
use crate::simulation::slots::port;

/// Requests Webots' end.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Stop(pub StopReason);

/// The simulation, which was kept ready, has a client: its time limit begins.
#[derive(Message)]
#[rtype(result = "()")]
pub struct HasClient;

/// The actor.
pub struct Webots {
    pub(super) spec: LaunchSpec,
    /// Whether it has had a client; it is kept ready otherwise.
    pub(super) has_client: bool,
    pub(super) state: State,
}

/// The life cycle of a Webots. Each state holds what exists only in it.
pub(super) enum State {
    /// Its containers are prepared, if it has any. Cancelling this job discards what was created.
    Preparing(SpawnHandle),
    /// Its process runs, and is not ready.
    Launching(Launching),
    /// Its world is ready.
    Ready(Ready),
    /// It was stopped, and its process tree ends.
    Stopping(Stopping),
    /// It has ended, and the actor stops. The session is notified when the actor is dropped.
    Ended(Failure),
}

pub(super) struct Launching {
    process: Process,
    /// Follows its start, once that has begun.
    startup: Option<SpawnHandle>,
    /// Whether it is known to have listened.
    has_listened: bool,
}

pub(super) struct Ready {
    pub(super) process: Process,
    last_heartbeat: Instant,
    /// Whether it has missed heartbeats.
    is_hanging: bool,
    /// The wait until it ends because it is paused.
    pub(super) idle_end: Option<IdleEnd>,
}

/// The wait until a simulation ends because it is paused.
pub(super) struct IdleEnd {
    /// The timer that continues the wait.
    pub(super) timer: SpawnHandle,
    /// Whether its client was notified of that end.
    pub(super) is_announced: bool,
}

pub(super) struct Stopping {
    tail: Tail,
    /// Whether it was ready before.
    was_ready: bool,
    /// Why it was stopped.
    failure: Failure,
}

/// A process that runs.
pub(super) struct Process {
    group: ProcessGroup,
    tail: Tail,
    /// Restarts the controller of a competition's participant.
    restart: Option<Arc<Notify>>,
    /// Whether the simulation is not paused, as its output shows.
    pub(super) is_running: bool,
}

/// Number of missed heartbeats after which Webots counts as hanging.
const MISSED_HEARTBEATS: u32 = 6;

impl State {
    /// The process, unless it is ending.
    fn process(&mut self) -> Option<&mut Process> {
        match self {
            Self::Launching(Launching { process, .. }) | Self::Ready(Ready { process, .. }) => Some(process),
            Self::Preparing(_) | Self::Stopping(_) | Self::Ended(_) => None,
        }
    }
}

impl Webots {
    /// Creates the actor, and prepares the containers of this Webots, if it has any; then it is launched.
    pub fn create(spec: LaunchSpec, has_client: bool, ctx: &mut Context<Self>) -> Self {
        let containers = spec.containers.clone();
        let session = spec.events.clone();
        let request = spec.request();
        let prepared = async move {
            let Some(containers) = containers else { return Ok(None) };
            // A full mailbox drops this line.
            let progress = move |progress| drop(session.try_send(WebotsEvent::Progress(progress)));
            let mut prepared = containers.prepare(request, &progress).await?;
            prepared.start_others().await.map(|()| Some(prepared))
        };
        let job = wrap_future::<_, Self>(prepared).map(|prepared, this, ctx| match prepared {
            Ok(containers) => this.launch(containers, ctx),
            Err(failure) => this.end(failure.into(), ctx),
        });
        Self {
            spec,
            has_client,
            state: State::Preparing(ctx.spawn(job)),
        }
    }

    fn launch(&mut self, containers: Option<SimulationContainers>, ctx: &mut Context<Self>) {
        let restart = containers.as_ref().and_then(SimulationContainers::restart);
        if let Some(SimulationContainers { warnings, texts, .. }) = &containers {
            for warning in warnings {
                self.send(WebotsEvent::Progress(Progress::new(Step::Image, warning.clone())));
            }
            for text in texts {
                self.send(WebotsEvent::Text(text.clone()));
            }
        }
        let process = match self.spawn(containers, restart, ctx) {
            Ok(process) => process,
            Err(error) => {
                let message = format!("Webots can't be started: {error}");
                return self.end(Failure::new(Reason::LaunchFailed, message).into(), ctx);
            }
        };
        self.state = State::Launching(Launching {
            process,
            startup: None,
            has_listened: false,
        });
        self.send(WebotsEvent::Started(Instant::now()));
        // In containers, the wait begins when the container reports that it runs.
        if self.spec.containers.is_none() {
            self.follow_startup(ctx);
        }
        ctx.run_later(self.spec.config.timing.launch, Self::check_launch);
        if self.has_client {
            self.limit_time(ctx);
        }
    }

    fn limit_time(&self, ctx: &mut Context<Self>) {
        let limit = self.spec.config.timeout;
        ctx.run_later(Duration::from_secs(limit), move |this, ctx| {
            let message = format!("The time limit of {limit} seconds was reached");
            this.stop(Failure::new(Reason::TimeLimit, message), ctx);
        });
    }

    /// Starts the process, and calls [`Self::exited`] when it has ended.
    fn spawn(
        &self,
        containers: Option<SimulationContainers>,
        restart: Option<Arc<Notify>>,
        ctx: &mut Context<Self>,
    ) -> std::io::Result<Process> {
        // Another program may have taken the port during the checkout, and would be mistaken for Webots.
        if !port::is_free(self.spec.slot.port) {
            return Err(std::io::ErrorKind::AddrInUse.into());
        }
        let (launched, exit) = launched::launch(&self.spec, containers, ctx.address().recipient())?;
        let LaunchedProcess { group, tail, log } = launched;
        let program = self.spec.program.display();
        let world = self.spec.project.world.path.display();
        let pid = group.leader();
        self.log(Level::Info, &format!("started {program} for {world} (process {pid})"));
        self.spec.slot.launched(pid, log);
        let exit = wrap_future::<_, Self>(exit).map(|exit, this, ctx| this.exited(&exit, ctx));
        ctx.spawn(exit);
        let excess = wrap_future::<_, Self>(self.spec.until_too_much(pid));
        ctx.spawn(excess.map(|why, this, ctx| this.stop(Failure::new(Reason::DiskLimit, why), ctx)));
        Ok(Process {
            group,
            tail,
            restart,
            is_running: false,
        })
    }

    /// Follows its start, unless that has begun.
    fn follow_startup(&mut self, ctx: &mut Context<Self>) {
        if let State::Launching(Launching {
            process,
            startup: startup @ None,
            ..
        }) = &mut self.state
        {
            let root = process.group.leader();
            let events = self.spec.follow_startup(root, ctx.address().recipient());
            *startup = Some(ctx.spawn(wrap_future(events)));
        }
    }

    fn become_ready(&mut self, ctx: &mut Context<Self>) {
        let process = match self.take_state() {
            State::Launching(Launching { process, startup, .. }) => {
                // A release that is ready by its heartbeat may never have been seen to listen.
                startup.map(|startup| ctx.cancel_future(startup));
                process
            }
            // It was ready before, by its port or its first heartbeat; or it is ending.
            other => return self.state = other,
        };
        self.log(Level::Info, "ready");
        let answers_controllers = !self.spec.is_ready_by_heartbeat();
        let stream = self.spec.slot.open_stream(answers_controllers, process.is_running);
        self.state = State::Ready(Ready {
            process,
            last_heartbeat: Instant::now(),
            is_hanging: false,
            idle_end: None,
        });
        self.send(WebotsEvent::Ready {
            port: self.spec.slot.port,
            stream,
        });
        ctx.run_interval(self.spec.config.timing.heartbeat, Self::check_heartbeat);
        self.used(ctx);
    }

    fn check_launch(&mut self, ctx: &mut Context<Self>) {
        if let State::Launching(_) = &self.state {
            let reason = match self.reached() {
                Reached::Start => Reason::LaunchFailed,
                Reached::Listening | Reached::Ready => Reason::LoadTimeout,
            };
            let limit = self.spec.config.timing.launch.as_secs();
            let message = format!("Webots did not become ready within {limit} seconds");
            self.stop(Failure::new(reason, message), ctx);
        }
    }

    /// Called only once the world is ready: Webots sends no heartbeat while it reads the world.
    fn check_heartbeat(&mut self, ctx: &mut Context<Self>) {
        let State::Ready(ready) = &mut self.state else { return };
        let silence = ready.last_heartbeat.elapsed();
        let hangs_after = self.spec.config.timing.heartbeat * MISSED_HEARTBEATS;
        if silence > hangs_after + self.spec.config.hang_limit {
            let message = format!("Webots gave no sign of life for {} seconds", silence.as_secs());
            self.stop(Failure::new(Reason::Hung, message), ctx);
        } else if silence > hangs_after && !ready.is_hanging {
            ready.is_hanging = true;
            self.log(Level::Warn, &format!("no sign of life for {} s", silence.as_secs()));
            self.send(WebotsEvent::Hanging(silence.as_secs()));
        }
    }

    /// Ends Webots: gracefully, or at once if it exceeds a limit, which it could exceed further in a grace period, or if no
    /// client has used it. Only the first reason counts.
    pub(super) fn stop(&mut self, failure: Failure, ctx: &mut Context<Self>) {
        let was_ready = matches!(self.state, State::Ready(_));
        let Process { mut group, tail, .. } = match self.take_state() {
            State::Preparing(job) => {
                ctx.cancel_future(job);
                return self.end(failure.into(), ctx);
            }
            State::Launching(Launching { process, .. }) | State::Ready(Ready { process, .. }) => process,
            other @ (State::Stopping(_) | State::Ended(_)) => return self.state = other,
        };
        let is_excess = failure.reason == Reason::DiskLimit;
        let level = if is_excess { Level::Warn } else { Level::Info };
        self.log(level, &format!("ending: {failure}"));
        // Something has failed, otherwise.
        if failure.reason.blame() == Blame::User || failure.reason == Reason::ServerStopped {
            self.spec.slot.ending(&failure.message);
        }
        if is_excess || !self.has_client {
            drop(group);
        } else {
            group.terminate();
        }
        self.spec.slot.stopping();
        self.state = State::Stopping(Stopping {
            tail,
            was_ready,
            failure,
        });
    }

    /// How far it came. In containers the project determines what runs: whatever happens there is not the server's
    /// fault, as far as Docker knows.
    fn reached(&self) -> Reached {
        match &self.state {
            State::Ready(_) => Reached::Ready,
            State::Launching(launching) if launching.has_listened || self.spec.containers.is_some() => {
                Reached::Listening
            }
            _ => Reached::Start,
        }
    }

    fn exited(&mut self, exit: &Exit, ctx: &mut Context<Self>) {
        self.log(Level::Info, &format!("Webots {}", exit.status));
        let observed = exit.failure(self.reached());
        let (failure, tail, was_ready) = match self.take_state() {
            State::Launching(Launching { process, .. }) => (observed, process.tail, false),
            State::Ready(Ready { process, .. }) => (observed, process.tail, true),
            State::Stopping(Stopping {
                failure,
                tail,
                was_ready,
            }) => (failure, tail, was_ready),
            // Only a process that was started exits, once.
            other @ (State::Preparing(_) | State::Ended(_)) => return self.state = other,
        };
        let reason = failure.reason;
        let mut told = failure.clone();
        if matches!(reason, Reason::LaunchFailed | Reason::LoadFailed | Reason::LoadTimeout) {
            told.message = format!("{}.{}", told.message, self.spec.launcher.remark());
        }
        if reason != Reason::Finished {
            told = told.with_output(tail.text(&self.spec.project.instance.project()));
        }
        let end = End {
            failure,
            taken: exit.taken,
        };
        self.spec.slot.end(end);
        if was_ready {
            self.spec.keep_assets();
        }
        self.state = State::Ended(told);
        ctx.stop();
    }

    /// Ends before Webots was started.
    fn end(&mut self, end: End, ctx: &mut Context<Self>) {
        self.spec.slot.end(end.clone());
        self.state = State::Ended(end.failure);
        ctx.stop();
    }

    /// Takes the state out, in order to enter another one.
    fn take_state(&mut self) -> State {
        std::mem::replace(&mut self.state, State::Ended(lost()))
    }

    pub(super) fn send(&self, event: WebotsEvent) {
        self.spec.events.do_send(event);
    }

    /// Logs an event with the port, and records it without: a client that has only a token must not learn the port.
    fn log(&self, level: Level, event: &str) {
        let with_port = format!("port {}: {event}", self.spec.slot.port);
        self.spec.slot.log(level, &with_port, event);
    }
}

impl Drop for Webots {
    /// Notifies the session of the end, even after a panic.
    fn drop(&mut self) {
        let failure = match self.take_state() {
            State::Ended(failure) => failure,
            _ => lost(),
        };
        self.send(WebotsEvent::Exited(failure));
    }
}

impl Actor for Webots {
    type Context = Context<Self>;
}

impl Handler<OutputEvent> for Webots {
    type Result = ();

    fn handle(&mut self, event: OutputEvent, ctx: &mut Self::Context) {
        if let State::Ready(ready) = &mut self.state {
            ready.last_heartbeat = Instant::now();
            ready.is_hanging = false;
        }
        match event {
            OutputEvent::Heartbeat => match &self.state {
                State::Ready(_) => self.send(WebotsEvent::Heartbeat),
                State::Launching(_) if self.spec.is_ready_by_heartbeat() => self.become_ready(ctx),
                _ => {}
            },
            OutputEvent::ContainerRuns => self.follow_startup(ctx),
            OutputEvent::Reset => {
                if let Some(Process {
                    restart: Some(controller),
                    ..
                }) = self.state.process()
                {
                    controller.notify_one();
                }
                self.used(ctx);
            }
            OutputEvent::Paused | OutputEvent::Running => {
                if let Some(process) = self.state.process() {
                    process.is_running = event == OutputEvent::Running;
                    self.spec.slot.set_running(event == OutputEvent::Running);
                }
                self.used(ctx);
            }
        }
    }
}

impl Handler<StartupEvent> for Webots {
    type Result = ();

    fn handle(&mut self, event: StartupEvent, ctx: &mut Self::Context) {
        match event {
            StartupEvent::Listening => {
                if let State::Launching(launching) = &mut self.state {
                    launching.has_listened = true;
                }
            }
            StartupEvent::Loading(progress) => self.send(WebotsEvent::Progress(progress)),
            StartupEvent::Ready => self.become_ready(ctx),
        }
    }
}

impl Handler<HasClient> for Webots {
    type Result = ();

    fn handle(&mut self, _: HasClient, ctx: &mut Self::Context) {
        self.has_client = true;
        if self.state.process().is_some() {
            self.limit_time(ctx);
        }
        self.used(ctx);
    }
}

impl Handler<Stop> for Webots {
    type Result = ();

    fn handle(&mut self, Stop(reason): Stop, ctx: &mut Self::Context) {
        self.stop(reason.into(), ctx);
    }
}
