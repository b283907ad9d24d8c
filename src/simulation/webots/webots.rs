//! Actor: one running Webots. Owns its process group, its folder and its place; ends with all three.
//!
//! Created by a web client once its project is checked out. It starts Webots, finds the port on which it listens,
//! watches its signs of life and the time limit, and tells its client with [`WebotsEvent`]s. It ends when nothing of
//! Webots' process tree is left, and is never restarted.

use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;

use super::event::{Exit, LastWord, WebotsEvent};
use super::launch_spec::Orders;
use super::output::{self, Sign, Tail};
use crate::shared::run::RotatedFile;
use crate::shared::run::seconds_since_1970;
use crate::simulation::census::{Change, Stage};
use crate::simulation::checkout::CheckoutError;
use crate::simulation::machine::display;
use crate::simulation::process::process_group::{Ending, ProcessGroup};
use crate::simulation::process::process_tree;

/// Asks Webots to end.
#[derive(Message)]
#[rtype(result = "()")]
pub struct End;

/// Asks for the original state of a file below the project's `controllers` folder.
#[derive(Message)]
#[rtype(result = "Result<(), CheckoutError>")]
pub struct RestoreController(pub String);

/// The actor.
pub struct Webots {
    orders: Orders,
    port: u16,
    events: LastWord,
    group: Option<ProcessGroup>,
    tail: Tail,
    listening: bool,
    /// Whether the simulation is not paused.
    runs: bool,
    last_sign: Instant,
    hanging: bool,
    /// Why it was asked to end, if it was.
    asked: Option<String>,
}

/// So many heartbeats may be missed before Webots counts as hanging.
const MISSED_HEARTBEATS: u32 = 6;
/// If its port is taken, Webots silently takes one of so many that follow.
const NEXT_PORTS: u16 = 10;
/// How many older files of its output are kept beside the newest.
const OLD_LOGS: usize = 1;
/// How long the rest of an output may take to be read.
const LAST_WORDS: Duration = Duration::from_secs(1);
/// Between two looks whether Webots listens, at first.
const FIRST_LOOK: Duration = Duration::from_millis(10);
/// Between two looks whether Webots listens, at most.
const SLOWEST_LOOK: Duration = Duration::from_millis(200);

impl Webots {
    /// Prepares a Webots; it starts with the actor.
    #[must_use]
    pub fn new(orders: Orders) -> Self {
        Self {
            port: orders.place.1,
            events: LastWord::new(orders.events.clone()),
            orders,
            group: None,
            tail: Tail::default(),
            listening: false,
            runs: false,
            last_sign: Instant::now(),
            hanging: false,
            asked: None,
        }
    }

    fn launch(&mut self, ctx: &mut Context<Self>) -> std::io::Result<()> {
        let log = self.orders.config.log_dir.0.join("simulation/instances").join(format!("{}.log", self.port));
        let begin = std::fs::metadata(&log).map_or(0, |file| file.len());
        let (reader, output) = std::io::pipe()?;
        let file = RotatedFile::open(&log, OLD_LOGS);
        if let Err(error) = &file {
            log::warn!(
                "port {}: what Webots prints is not kept: {} can't be written: {error}",
                self.port,
                log.display()
            );
        }
        let log = file.is_ok().then_some(log);
        let (tail, all_read) = output::follow(reader, file.ok(), ctx.address())?;
        self.tail = tail;
        let errors = output.try_clone()?;
        let (group, ended) = ProcessGroup::start(&self.orders.plan(), output.into(), errors.into())?;
        log::info!(
            "port {}: started {} for {} (guardian {})",
            self.port,
            self.orders.program.display(),
            self.orders.project.world.path.display(),
            group.guardian()
        );
        let (at, pid) = (seconds_since_1970(), group.guardian());
        self.orders.place.0.update(Change::Launched { at, pid, port: self.port, log, begin });
        self.group = Some(group);
        let ended = async move {
            let ending = ended.await;
            // What was printed last tells why. A process that nobody can end may keep the pipe open.
            actix_rt::time::timeout(LAST_WORDS, all_read).await.ok();
            ending
        };
        ended.into_actor(self).map(|ending, this, ctx| this.ended(ending, ctx)).spawn(ctx);
        self.look_for_port(FIRST_LOOK, ctx);
        ctx.run_interval(self.orders.config.timing.heartbeat, Self::check_signs);
        let limit = self.orders.config.timing.launch;
        ctx.run_later(limit, move |this, _| {
            if !this.listening {
                this.end(&format!("Webots did not become ready within {} seconds", limit.as_secs()));
            }
        });
        let limit = self.orders.config.timeout;
        ctx.run_later(Duration::from_secs(limit), move |this, _| {
            this.end(&format!("The time limit of {limit} seconds was reached"));
        });
        Ok(())
    }

    /// Looks whether a process of this instance listens on a port that Webots may have taken.
    fn look_for_port(&self, pause: Duration, ctx: &mut Context<Self>) {
        let Some(root) = self.group.as_ref().map(ProcessGroup::guardian) else {
            return;
        };
        let ports = self.port..=self.port.saturating_add(NEXT_PORTS);
        let look = async move {
            actix_rt::time::sleep(pause).await;
            actix_rt::task::spawn_blocking(move || process_tree::listening_port(root, &ports)).await.unwrap_or_default()
        };
        look.into_actor(self)
            .map(move |port, this, ctx| match port {
                Some(port) => this.ready(port),
                None => this.look_for_port((pause * 3 / 2).min(SLOWEST_LOOK), ctx),
            })
            .spawn(ctx);
    }

    fn ready(&mut self, port: u16) {
        if self.asked.is_some() {
            return;
        }
        let allowed = self.orders.config.streaming_ports();
        if !allowed.contains(&port) {
            let (first, last) = (allowed.start(), allowed.end());
            return self
                .end(&format!("Webots listens on port {port}, outside of this server's ports {first} to {last}"));
        }
        if port != self.port {
            log::warn!("port {}: it was taken, Webots listens on {port}", self.port);
        }
        log::info!("port {port}: ready");
        self.listening = true;
        self.last_sign = Instant::now();
        self.orders.place.0.update(Change::Port(port));
        self.show_pace();
        self.tell(WebotsEvent::Listening(port));
    }

    /// Shows whether the simulation runs; a Webots that is starting or ending is shown as that.
    fn show_pace(&self) {
        if self.listening && self.asked.is_none() {
            self.orders.place.0.update(Change::Stage(if self.runs { Stage::Running } else { Stage::Idle }));
        }
    }

    fn check_signs(&mut self, _: &mut Context<Self>) {
        // Until it listens, the time for its launch counts.
        if !self.listening {
            return;
        }
        let silence = self.last_sign.elapsed();
        let hangs_after = self.orders.config.timing.heartbeat * MISSED_HEARTBEATS;
        if silence > hangs_after + self.orders.config.hang_limit {
            self.end(&format!("Webots gave no sign of life for {} seconds", silence.as_secs()));
        } else if silence > hangs_after && !self.hanging {
            self.hanging = true;
            log::warn!("port {}: no sign of life for {} s", self.port, silence.as_secs());
            self.tell(WebotsEvent::Hanging(silence.as_secs()));
        }
    }

    /// Asks for an orderly end. The first reason is the one that is told.
    fn end(&mut self, why: &str) {
        if self.asked.is_none() {
            log::info!("port {}: ending: {why}", self.port);
            self.asked = Some(why.to_owned());
            self.orders.place.0.update(Change::Stage(Stage::Stopping));
            if let Some(group) = &mut self.group {
                group.ask_to_end();
            }
        }
    }

    fn ended(&mut self, ending: Ending, ctx: &mut Context<Self>) {
        log::info!("port {}: Webots {ending}", self.port);
        let exit = match self.asked.take() {
            Some(why) => Exit { clean: false, why: self.with_last_lines(&why) },
            None if ending == Ending::Code(0) => Exit { clean: true, why: "Webots has ended".to_owned() },
            None => Exit { clean: false, why: self.with_last_lines(&format!("Webots {ending}")) },
        };
        if exit.clean || self.listening || self.orders.config.xvfb {
            return self.exited(exit, ctx);
        }
        let display = display::effective(self.orders.config.display.as_ref());
        let look = actix_rt::task::spawn_blocking(move || display::look(&display).err());
        look.into_actor(self)
            .map(move |hint, this, ctx| {
                let hint = hint.ok().flatten().map(|hint| format!(" Note: {hint}.")).unwrap_or_default();
                this.exited(Exit { clean: false, why: exit.why.clone() + &hint }, ctx);
            })
            .spawn(ctx);
    }

    fn exited(&mut self, exit: Exit, ctx: &mut Context<Self>) {
        self.tell(WebotsEvent::Exited(exit));
        ctx.stop();
    }

    /// What a user needs to understand an end: the last of what was printed.
    fn with_last_lines(&self, why: &str) -> String {
        let lines = self.tail.lines();
        if lines.is_empty() { format!("{why}.") } else { format!("{why}. Its last output: {}", lines.join(" | ")) }
    }

    fn tell(&mut self, event: WebotsEvent) {
        self.events.tell(event);
    }
}

impl Actor for Webots {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        if let Err(error) = self.launch(ctx) {
            log::error!("port {}: Webots can't be started: {error}", self.port);
            self.tell(WebotsEvent::Exited(Exit { clean: false, why: format!("Webots can't be started: {error}") }));
            ctx.stop();
        }
    }
}

impl Handler<Sign> for Webots {
    type Result = ();

    fn handle(&mut self, sign: Sign, _: &mut Self::Context) {
        self.last_sign = Instant::now();
        self.hanging = false;
        match sign {
            Sign::Heartbeat if self.listening => self.tell(WebotsEvent::Heartbeat),
            Sign::Heartbeat => {}
            Sign::Paused | Sign::Running => {
                self.runs = sign == Sign::Running;
                self.show_pace();
            }
        }
    }
}

impl Handler<RestoreController> for Webots {
    type Result = ResponseFuture<Result<(), CheckoutError>>;

    fn handle(&mut self, RestoreController(file): RestoreController, _: &mut Self::Context) -> Self::Result {
        let (checkouts, project) = (Arc::clone(&self.orders.checkouts), Arc::clone(&self.orders.project));
        Box::pin(async move { checkouts.restore_controller(&project, &file).await })
    }
}

impl Handler<End> for Webots {
    type Result = ();

    fn handle(&mut self, _: End, _: &mut Self::Context) {
        self.end("Its client has gone");
    }
}
