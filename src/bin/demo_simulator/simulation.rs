//! The actor that runs the simulation: it loads worlds, advances the clock and executes the clients' requests. Created
//! by `run`, lives as long as the program. Receives events from the clients and answers through their handles; notifies
//! `run` if the first world cannot be read.

use std::time::{Duration, Instant};

use actix::{
    Actor, ActorFutureExt as _, AsyncContext as _, Context, Handler, Message, ResponseFuture, SpawnHandle,
    WrapFuture as _,
};
use tokio::sync::oneshot;
use tokio::task::spawn_blocking;

use crate::client::{ClientId, Event};
use crate::clients::Clients;
use crate::clock::{Clock, Mode, Progress};
use crate::console::{self, Console};
use crate::protocol::{self, Command};
use crate::scene::Scene;
use crate::world::{WorldError, WorldFile, WorldNames};

/// Closes the WebSockets of all clients. Answered when all are closed.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct CloseClients;

/// The simulation.
pub(crate) struct Simulation {
    file: WorldFile,
    names: WorldNames,
    /// `None` while it is being loaded.
    scene: Option<Scene>,
    clock: Clock,
    clients: Clients,
    /// Clients that requested the scene while it was being loaded.
    waiting: Vec<ClientId>,
    console: Console,
    /// Whether clients are served at all.
    stream: bool,
    /// Fires as long as time runs.
    ticker: Option<SpawnHandle>,
    last_tick: Instant,
    /// Reports that the first world cannot be read.
    failure: Option<oneshot::Sender<WorldError>>,
}

impl Simulation {
    /// A simulation of `file` that starts in `mode`. `failure` receives the error if the file cannot be read.
    pub(crate) fn new(
        file: WorldFile,
        mode: Mode,
        stream: bool,
        console: Console,
        failure: oneshot::Sender<WorldError>,
    ) -> Self {
        Self {
            file,
            names: WorldNames::default(),
            clock: Clock::new(mode, Scene::empty().step()),
            scene: None,
            clients: Clients::default(),
            waiting: Vec::new(),
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
            Event::Connected(id, handle) => self.clients.add(id, handle),
            Event::Disconnected(id) => self.clients.remove(id),
            // like Webots without `--stream`: the client gets no answer
            Event::Received(..) if !self.stream => (),
            Event::Received(id, text, _permit) => match Command::parse(&text) {
                Some(command) => self.obey(command, id, ctx),
                None => self.error(&format!(
                    "Unsupported message: {:?}.",
                    text.chars().take(100).collect::<String>()
                )),
            },
        }
    }
}

impl Handler<CloseClients> for Simulation {
    type Result = ResponseFuture<()>;

    fn handle(&mut self, _: CloseClients, _: &mut Self::Context) -> Self::Result {
        let closed = self.clients.close();
        Box::pin(async { drop(closed.await) })
    }
}

/// Requests of clients.
impl Simulation {
    fn obey(&mut self, command: Command, id: ClientId, ctx: &mut Context<Self>) {
        match command {
            Command::Watch { broadcast } => {
                self.clock.set_timeout(if broadcast { f64::INFINITY } else { 0.0 });
                self.watch(id);
            }
            Command::WatchPictures => self.error("this simulator renders no pictures."),
            Command::Pause => self.pause(id, ctx),
            Command::RealTime(timeout) => self.run(Mode::RealTime, timeout, id, ctx),
            Command::Fast(timeout) => self.run(Mode::Fast, timeout, id, ctx),
            Command::Step => {
                console::status("step");
                self.clock.step();
                self.send_update();
                self.pause(id, ctx);
            }
            Command::Reset => self.reset(),
            Command::Reload => self.change_world(self.file.clone(), ctx),
            Command::Load(name) => match self.file.sibling(&name) {
                Some(file) => self.change_world(file, ctx),
                None => self.error(&format!("there is no world {name:?}.")),
            },
            Command::Timeout(timeout) => self.clock.set_timeout(timeout),
            Command::Robot => (), // there are no controllers
        }
    }

    fn watch(&mut self, id: ClientId) {
        self.clients.watch(id);
        if self.scene.is_some() {
            for text in self.scene_texts() {
                self.clients.send(id, text);
            }
            self.clients.send(id, self.state());
        } else {
            self.waiting.push(id);
            self.clients.send(id, protocol::loading(protocol::READING, 0));
        }
    }

    fn pause(&mut self, id: ClientId, ctx: &mut Context<Self>) {
        self.set_mode(Mode::Pause, ctx);
        console::status("pause");
        self.clients.send(id, protocol::PAUSED_BY_CLIENT);
    }

    fn run(&mut self, mode: Mode, timeout: f64, id: ClientId, ctx: &mut Context<Self>) {
        self.clock.set_timeout(timeout);
        self.set_mode(mode, ctx);
        let state = self.state();
        console::status(&state);
        self.clients.send(id, state);
    }

    fn reset(&mut self) {
        console::status("reset");
        self.clock.reset();
        if let Some(scene) = &self.scene {
            self.clients.broadcast(protocol::update(&scene.update(0.0)));
            self.clients.broadcast(protocol::RESET_FINISHED);
        }
    }

    fn error(&self, text: &str) {
        self.console.error(format_args!("Streaming server: {text}"));
    }

    /// The clock's state, as it is sent to clients.
    fn state(&self) -> String {
        match self.clock.mode() {
            Mode::Pause => protocol::paused(self.clock.now()),
            Mode::RealTime => protocol::REAL_TIME.to_owned(),
            Mode::Fast => protocol::FAST.to_owned(),
        }
    }

    fn scene_texts(&self) -> Vec<String> {
        let Some(scene) = &self.scene else { return Vec::new() };
        vec![
            protocol::world(&self.names),
            protocol::model(&scene.model),
            protocol::update(&scene.update(self.clock.now())),
            protocol::SCENE_COMPLETED.to_owned(),
        ]
    }
}

/// Loading of worlds.
impl Simulation {
    fn change_world(&mut self, file: WorldFile, ctx: &mut Context<Self>) {
        if self.scene.take().is_none() {
            self.error("a world is being loaded already.");
            return;
        }
        self.file = file;
        self.clients.broadcast(protocol::DELETE_WORLD);
        self.clients.broadcast(protocol::loading(protocol::READING, 0));
        self.load(ctx);
    }

    fn load(&mut self, ctx: &mut Context<Self>) {
        self.stop_ticker(ctx);
        let file = self.file.clone();
        let loading = spawn_blocking(move || (file.names(), file.load())).into_actor(self);
        ctx.spawn(loading.map(|outcome, simulation, ctx| match outcome {
            Ok((names, scene)) => simulation.loaded(names, scene, ctx),
            Err(error) => simulation.console.error(error),
        }));
    }

    /// Sends the scene to all clients that watch: from time 0, in the same mode.
    fn loaded(&mut self, names: WorldNames, scene: Result<Scene, WorldError>, ctx: &mut Context<Self>) {
        let scene = match (scene, self.failure.take()) {
            (Ok(scene), _) => scene,
            (Err(error @ WorldError::Unreadable { .. }), Some(failure)) => {
                drop(failure.send(error));
                return;
            }
            // like Webots: the empty world replaces it
            (Err(error), _) => {
                self.console
                    .error(format_args!("'{}': {error}", self.file.path().display()));
                Scene::empty()
            }
        };
        self.clock.restart(scene.step());
        self.names = names;
        self.scene = Some(scene);
        for status in ["Parsing world", "Finalizing nodes"] {
            self.clients.broadcast(protocol::loading(status, 100));
        }
        for text in self.scene_texts() {
            self.clients.broadcast(text);
        }
        for id in std::mem::take(&mut self.waiting) {
            self.clients.send(id, self.state());
        }
        self.set_mode(self.clock.mode(), ctx);
    }
}

/// The passing of time.
impl Simulation {
    fn set_mode(&mut self, mode: Mode, ctx: &mut Context<Self>) {
        self.clock.set_mode(mode);
        self.stop_ticker(ctx);
        let Some(scene) = &self.scene else { return };
        let frame = Duration::from_secs_f64(1.0 / scene.fps());
        let period = match mode {
            Mode::Pause => {
                let update = protocol::update(&scene.update(self.clock.now()));
                return self.clients.send_missed_update(update);
            }
            Mode::RealTime => frame.max(Duration::from_secs_f64(scene.step() / 1000.0)),
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
        let progress = self.clock.advance(now - self.last_tick);
        self.last_tick = now;
        if progress == Progress::None {
            return;
        }
        self.send_update();
        if progress == Progress::TimedOut {
            self.set_mode(Mode::Pause, ctx);
            console::status("pause");
            self.clients.broadcast(self.state());
        }
    }

    fn send_update(&mut self) {
        if let Some(scene) = &self.scene {
            self.clients
                .broadcast_update(protocol::update(&scene.update(self.clock.now())));
        }
    }
}
