//! The actor that runs the simulation: it loads worlds, advances the clock and executes the clients' requests. Created
//! by `run`, lives as long as the program. Receives events from the clients and answers through their handles; notifies
//! `run` if the first world cannot be read.

use std::thread;
use std::time::{Duration, Instant};

use actix::{
    Actor, ActorFutureExt as _, AsyncContext as _, Context, Handler, Message, MessageResult, ResponseFuture,
    SpawnHandle, WrapFuture as _,
};
use nix::sys::signal::{Signal, raise};
use nix::time::{ClockId, clock_gettime};
use tokio::sync::oneshot;

use crate::client::{ClientId, Event};
use crate::clients::Clients;
use crate::clock::{Clock, Mode, Progress};
use crate::console::{self, Console};
use crate::phases::Phases;
use crate::protocol::{self, Command};
use crate::scene::Scene;
use crate::world::{Release, WorldError, WorldFile, WorldNames};

/// Messages about the progress of a download.
const STEPS: u8 = 10;
/// Time that the clients' tasks have to send the progress before the thread is blocked.
const FLUSH: Duration = Duration::from_millis(10);

/// The most simulated time that is made at once by a world that needs processor time.
const CATCH_UP: Duration = Duration::from_millis(200);

/// The least time between two ticks of a world that needs processor time.
const YIELD: Duration = Duration::from_millis(1);

/// Closes the WebSockets of all clients. Answered when all are closed.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct CloseClients;

/// A controller requests a connection to a robot; none is there. Answered with the text for it.
#[derive(Message)]
#[rtype(result = "&'static str")]
pub(crate) struct ConnectController;

/// Prints a warning, and sends it to the clients.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct Warn(pub(crate) String);

/// The simulation.
pub(crate) struct Simulation {
    file: WorldFile,
    names: WorldNames,
    /// That of the world which was last opened.
    release: Release,
    /// `None` while the world's assets are downloaded. While it is read, nothing runs.
    scene: Option<Scene>,
    clock: Clock,
    /// Processor time that a second of simulation needs.
    work: Duration,
    /// Simulation time of the last update, in milliseconds.
    updated: f64,
    clients: Clients,
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
            release: Release::default(),
            clock: Clock::new(mode, Scene::empty().step()),
            work: Duration::ZERO,
            updated: 0.0,
            scene: None,
            clients: Clients::default(),
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
        self.open(ctx);
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
            Event::Received(id, text) => match Command::parse(&text, self.release.scene_request()) {
                Some(command) => self.obey(command, id, ctx),
                None => self.error(&format!("Streaming server: Unsupported message: {text}.")),
            },
        }
    }
}

impl Handler<ConnectController> for Simulation {
    type Result = MessageResult<ConnectController>;

    fn handle(&mut self, _: ConnectController, _: &mut Self::Context) -> Self::Result {
        if self.scene.is_some() {
            return MessageResult(protocol::FAILED);
        }
        if !self.release.answers_controllers_at_once() {
            crash();
        }
        MessageResult(protocol::PROCESSING)
    }
}

impl Handler<Warn> for Simulation {
    type Result = ();

    fn handle(&mut self, Warn(text): Warn, _: &mut Self::Context) {
        self.trouble(&format!("WARNING: {text}"));
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
                // for all clients, as in Webots
                self.clock.set_timeout(if broadcast { f64::INFINITY } else { 0.0 });
                self.watch(id);
            }
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
                None => self.error(&format!("Streaming server: world {name} doesn't exist.")),
            },
            Command::Timeout(timeout) => self.clock.set_timeout(timeout),
            Command::Robot => (), // there are no controllers
        }
    }

    fn watch(&mut self, id: ClientId) {
        let Some(texts) = self.scene_texts() else {
            // Webots dereferences the world that is not there
            crash();
        };
        for text in texts {
            self.clients.send(id, text);
        }
        self.clients.send(id, self.state());
        self.clients.start_console();
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
        self.updated = 0.0;
        if let Some(scene) = &self.scene {
            self.clients.broadcast(protocol::update(&scene.state(0.0)));
            self.clients.broadcast(protocol::RESET_FINISHED);
        }
    }

    fn error(&mut self, text: &str) {
        self.trouble(&format!("ERROR: {text}"));
    }

    /// Prints a warning or an error, and sends it to the clients.
    fn trouble(&mut self, line: &str) {
        self.console.trouble(line);
        self.clients.log(protocol::stderr(line));
    }

    /// The clock's state, as it is sent to clients.
    fn state(&self) -> String {
        match self.clock.mode() {
            Mode::Pause => protocol::paused(self.clock.now()),
            Mode::RealTime => protocol::REAL_TIME.to_owned(),
            Mode::Fast => protocol::FAST.to_owned(),
        }
    }

    fn scene_texts(&self) -> Option<Vec<String>> {
        let scene = self.scene.as_ref()?;
        let mut texts = vec![
            protocol::world(&self.names),
            protocol::model(&scene.model),
            protocol::update(&scene.state(self.clock.now())),
        ];
        texts.extend(scene.windows.iter().map(protocol::robot_window));
        texts.push(protocol::SCENE_COMPLETED.to_owned());
        Some(texts)
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
        self.stop_ticker(ctx);
        self.open(ctx);
    }

    /// Opens the world: downloads its assets, then reads it.
    fn open(&mut self, ctx: &mut Context<Self>) {
        let phases = match (self.file.header(), self.failure.take()) {
            (Ok(header), _) => {
                self.release = header.release;
                header.phases
            }
            (Err(error @ WorldError::Unreadable { .. }), Some(failure)) => {
                drop(failure.send(error));
                return;
            }
            // like Webots: the empty world replaces it
            (Err(error), _) => {
                self.error(&format!("'{}': {error}", self.file.path().display()));
                return self.loaded(Scene::empty(), Phases::default(), ctx);
            }
        };
        if phases.download.is_zero() {
            return self.read(phases, ctx);
        }
        for step in 0..STEPS {
            let progress = protocol::loading(protocol::DOWNLOADING, 100 / STEPS * step);
            let time = phases.download * u32::from(step) / u32::from(STEPS);
            ctx.run_later(time, move |simulation, _| simulation.clients.broadcast(progress));
        }
        ctx.run_later(phases.download, move |simulation, ctx| simulation.read(phases, ctx));
    }

    /// Reads the world, which blocks the thread.
    fn read(&mut self, phases: Phases, ctx: &mut Context<Self>) {
        self.clients.broadcast(protocol::loading(protocol::READING, 0));
        if phases.load.is_zero() {
            return self.finish_loading(phases, ctx);
        }
        // Webots sends the progress before it blocks. This actor handles no message meanwhile.
        let blocked = async move {
            tokio::time::sleep(FLUSH).await;
            thread::sleep(phases.load);
        };
        ctx.wait(
            blocked
                .into_actor(self)
                .map(move |(), simulation, ctx| simulation.finish_loading(phases, ctx)),
        );
    }

    fn finish_loading(&mut self, phases: Phases, ctx: &mut Context<Self>) {
        let scene = self.file.load().unwrap_or_else(|error| {
            self.error(&format!("'{}': {error}", self.file.path().display()));
            Scene::empty()
        });
        self.loaded(scene, phases, ctx);
    }

    /// Sends the scene to all clients: from time 0, in the same mode.
    fn loaded(&mut self, scene: Scene, phases: Phases, ctx: &mut Context<Self>) {
        self.clock.restart(scene.step());
        self.updated = 0.0;
        self.work = phases.work;
        self.names = self.file.names();
        self.scene = Some(scene);
        for status in ["Parsing world", "Finalizing nodes"] {
            self.clients.broadcast(protocol::loading(status, 100));
        }
        for text in self.scene_texts().unwrap_or_default() {
            self.clients.broadcast(text);
        }
        self.set_mode(self.clock.mode(), ctx);
        if let Some(busy) = phases.busy {
            ctx.run_later(busy.after, move |_, _| thread::sleep(busy.length));
        }
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
                let update = protocol::update(&scene.state(self.clock.now()));
                return self.clients.send_missed_update(update);
            }
            Mode::RealTime => frame.max(Duration::from_secs_f64(scene.step() / 1000.0)),
            Mode::Fast => frame,
        };
        self.last_tick = Instant::now();
        self.ticker = Some(if self.work.is_zero() {
            ctx.run_interval(period, Self::tick)
        } else {
            ctx.run_later(period, move |simulation, ctx| simulation.work_and_tick(period, ctx))
        });
    }

    /// A tick of a world that needs processor time. The next one comes later if this one has taken longer, so that
    /// messages are handled meanwhile.
    fn work_and_tick(&mut self, period: Duration, ctx: &mut Context<Self>) {
        let begin = Instant::now();
        self.tick(ctx);
        if self.clock.mode() != Mode::Pause {
            let rest = period.saturating_sub(begin.elapsed()).max(YIELD);
            let next = ctx.run_later(rest, move |simulation, ctx| simulation.work_and_tick(period, ctx));
            self.ticker = Some(next);
        }
    }

    fn stop_ticker(&mut self, ctx: &mut Context<Self>) {
        if let Some(ticker) = self.ticker.take() {
            ctx.cancel_future(ticker);
        }
    }

    fn tick(&mut self, ctx: &mut Context<Self>) {
        let now = Instant::now();
        let before = self.clock.now();
        let mut elapsed = now - self.last_tick;
        if !self.work.is_zero() {
            // A simulation that is too slow does not catch up.
            elapsed = elapsed.min(CATCH_UP);
        }
        let progress = self.clock.advance(elapsed, !self.clients.is_empty());
        self.last_tick = now;
        work(self.work.mul_f64((self.clock.now() - before).max(0.0) / 1000.0));
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
        let Some(scene) = &self.scene else { return };
        let now = self.clock.now();
        for update in scene.updates(self.updated, now) {
            self.clients
                .broadcast_update(protocol::update(&update), || protocol::update(&scene.state(now)));
        }
        self.updated = now;
    }
}

/// Keeps a processor busy until this thread has used so much of its time.
fn work(time: Duration) {
    let used = || {
        clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID)
            .map(Duration::from)
            .unwrap_or_default()
    };
    let begin = used();
    while used().saturating_sub(begin) < time {
        std::hint::spin_loop();
    }
}

/// Ends the program as an access to memory that is not there would. The first signal only resets the handler that Rust
/// installs for it.
fn crash() -> ! {
    loop {
        raise(Signal::SIGSEGV).ok();
    }
}
