//! The actor that runs the simulation: it has worlds loaded, makes time pass, and does what clients ask
//! for. Created by `run`, lives as long as the program. Hears events from the clients and answers through
//! their outboxes; tells `run` if the first world cannot be read.

use std::time::{Duration, Instant};

use actix::{Actor, ActorFutureExt as _, AsyncContext as _, Context, Handler, Message, SpawnHandle, WrapFuture as _};
use tokio::sync::oneshot;
use tokio::task::spawn_blocking;

use crate::client::{ClientId, Event};
use crate::clock::{Mode, Progress};
use crate::console::{self, Console};
use crate::protocol::{self, Command};
use crate::stage::Stage;
use crate::world::{Loaded, World, WorldError, WorldFile};

/// Says goodbye to all clients.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct CloseAll;

/// The simulation.
pub(crate) struct Simulation {
    file: WorldFile,
    stage: Stage,
    console: Console,
    /// Whether clients can watch at all.
    stream: bool,
    /// Fires as long as time runs.
    ticker: Option<SpawnHandle>,
    last_tick: Instant,
    /// Where to report that the first world cannot be read.
    failure: Option<oneshot::Sender<WorldError>>,
}

impl Simulation {
    /// A simulation of `file` that starts in `mode`. If the file cannot be read, `failure` hears of it.
    pub(crate) fn new(
        file: WorldFile,
        mode: Mode,
        stream: bool,
        console: Console,
        failure: oneshot::Sender<WorldError>,
    ) -> Self {
        Self {
            file,
            stage: Stage::new(mode),
            console,
            stream,
            ticker: None,
            last_tick: Instant::now(),
            failure: Some(failure),
        }
    }
}

impl Actor for Simulation {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        self.load(ctx);
    }
}

impl Handler<Event> for Simulation {
    type Result = ();

    fn handle(&mut self, event: Event, ctx: &mut Self::Context) {
        match event {
            Event::Joined(id, outbox) => self.stage.audience.join(id, outbox),
            Event::Left(id) => self.stage.audience.leave(id),
            Event::Said(id, text, unheard) => {
                self.hear(id, &text, ctx);
                drop(unheard);
            }
        }
    }
}

impl Handler<CloseAll> for Simulation {
    type Result = ();

    fn handle(&mut self, _: CloseAll, _: &mut Self::Context) {
        self.stage.audience.close();
    }
}

/// What clients ask for.
impl Simulation {
    fn hear(&mut self, id: ClientId, text: &str, ctx: &mut Context<Self>) {
        match Command::parse(text) {
            // like Webots without `--stream`: the client is left waiting
            _ if !self.stream => (),
            Some(command) => self.obey(command, id, ctx),
            None => self.complain_about(text),
        }
    }

    fn obey(&mut self, command: Command, id: ClientId, ctx: &mut Context<Self>) {
        match command {
            Command::Watch { broadcast } => {
                let timeout = if broadcast { f64::INFINITY } else { 0.0 };
                self.stage.clock.set_timeout(timeout);
                self.stage.admit(id);
            }
            Command::WatchPictures => self.error("this simulator renders no pictures."),
            Command::Pause => self.pause(id, ctx),
            Command::RealTime(timeout) => self.run(Mode::RealTime, timeout, id, ctx),
            Command::Fast(timeout) => self.run(Mode::Fast, timeout, id, ctx),
            Command::Step => {
                console::status("step");
                self.stage.step();
                self.pause(id, ctx);
            }
            Command::Reset => {
                console::status("reset");
                self.stage.reset();
            }
            Command::Reload => self.change_world(self.file.clone(), ctx),
            Command::Load(name) => match self.file.sibling(&name) {
                Some(file) => self.change_world(file, ctx),
                None => self.error(&format!("there is no world {name:?}.")),
            },
            Command::Timeout(timeout) => self.stage.clock.set_timeout(timeout),
            Command::Robot => (), // no controller is there to hear it
        }
    }

    fn pause(&mut self, id: ClientId, ctx: &mut Context<Self>) {
        self.set_mode(Mode::Pause, ctx);
        console::status("pause");
        self.stage.audience.tell(id, protocol::PAUSED_BY_CLIENT);
    }

    fn run(&mut self, mode: Mode, timeout: f64, id: ClientId, ctx: &mut Context<Self>) {
        self.stage.clock.set_timeout(timeout);
        self.set_mode(mode, ctx);
        let name = match mode {
            Mode::Fast => protocol::FAST,
            _ => protocol::REAL_TIME,
        };
        console::status(name);
        self.stage.audience.tell(id, name);
    }

    fn change_world(&mut self, file: WorldFile, ctx: &mut Context<Self>) {
        if self.stage.clear() {
            self.file = file;
            self.load(ctx);
        } else {
            self.error("a world is being loaded already.");
        }
    }

    fn complain_about(&self, text: &str) {
        let start: String = text.chars().take(100).collect();
        self.error(&format!("Unsupported message: {start:?}."));
    }

    fn error(&self, text: &str) {
        self.console.error(format_args!("Streaming server: {text}"));
    }
}

/// How worlds come in.
impl Simulation {
    fn load(&mut self, ctx: &mut Context<Self>) {
        self.stop_ticker(ctx);
        let file = self.file.clone();
        let loading = spawn_blocking(move || file.load()).into_actor(self);
        ctx.spawn(loading.map(|outcome, simulation, ctx| match outcome {
            Ok(loaded) => simulation.loaded(loaded, ctx),
            Err(error) => simulation.console.error(error),
        }));
    }

    fn loaded(&mut self, loaded: Loaded, ctx: &mut Context<Self>) {
        let world = match (loaded.world, self.failure.take()) {
            (Ok(world), _) => Ok(world),
            (Err(error @ WorldError::Unreadable { .. }), Some(failure)) => {
                drop(failure.send(error));
                return;
            }
            (Err(error), _) => {
                let path = self.file.path().display();
                self.console.error(format_args!("'{path}': {error}"));
                World::empty()
            }
        };
        match world {
            Ok(world) => self.stage.open(world, loaded.names),
            Err(error) => self.console.error(error),
        }
        self.set_mode(self.stage.clock.mode(), ctx);
    }
}

/// How time passes.
impl Simulation {
    fn set_mode(&mut self, mode: Mode, ctx: &mut Context<Self>) {
        self.stage.clock.set_mode(mode);
        self.stop_ticker(ctx);
        let Some(world) = self.stage.world() else {
            return;
        };
        let frame = Duration::from_secs_f64(1.0 / world.fps);
        let step = Duration::from_secs_f64(world.time_step / 1000.0);
        let period = match mode {
            Mode::Pause => return self.stage.catch_up(),
            Mode::RealTime => frame.max(step),
            Mode::Fast => frame,
        };
        self.last_tick = Instant::now();
        self.ticker = Some(ctx.run_interval(period, Self::tick));
    }

    fn stop_ticker(&mut self, ctx: &mut Context<Self>) {
        if let Some(ticker) = self.ticker.take() {
            ctx.cancel_future(ticker);
        }
    }

    fn tick(&mut self, ctx: &mut Context<Self>) {
        let now = Instant::now();
        let progress = self.stage.clock.advance(now - self.last_tick);
        self.last_tick = now;
        if progress == Progress::Nothing {
            return;
        }
        self.stage.show_changes();
        if progress == Progress::TimedOut {
            self.set_mode(Mode::Pause, ctx);
            console::status("pause");
            let state = protocol::paused(self.stage.clock.now());
            self.stage.audience.tell_watchers(state);
        }
    }
}
