//! What is played and who watches it: the world, its clock and its audience. Owned by the simulation, which
//! says what happens; here it is done, and the audience told. Knows nothing of timers and files.

use crate::audience::Audience;
use crate::client::ClientId;
use crate::clock::{Clock, Mode};
use crate::protocol;
use crate::world::{Names, World};

/// The length of a step while there is no world, when time stands still.
const NO_WORLD_STEP: f64 = 32.0;

/// The world, its clock and its audience.
pub(crate) struct Stage {
    /// None while it is being loaded.
    world: Option<World>,
    names: Names,
    /// Who wanted to watch while there was nothing to see.
    newcomers: Vec<ClientId>,
    /// The world's time.
    pub(crate) clock: Clock,
    /// Everybody who is connected.
    pub(crate) audience: Audience,
}

impl Stage {
    /// A stage that waits for its first world, to be played in `mode`.
    pub(crate) fn new(mode: Mode) -> Self {
        Self {
            world: None,
            names: Names::default(),
            newcomers: Vec::new(),
            clock: Clock::new(mode, NO_WORLD_STEP),
            audience: Audience::default(),
        }
    }

    /// The world, unless it is being loaded.
    pub(crate) fn world(&self) -> Option<&World> {
        self.world.as_ref()
    }

    /// Another world is going to be loaded; false if one is being loaded already.
    pub(crate) fn clear(&mut self) -> bool {
        let was_playing = self.world.take().is_some();
        if was_playing {
            self.audience.tell_watchers(protocol::DELETE_WORLD);
            self.audience.tell_watchers(reading());
        }
        was_playing
    }

    /// A world has been loaded: plays it from time 0, in the same mode.
    pub(crate) fn open(&mut self, mut world: World, names: Names) {
        self.clock.restart(world.time_step);
        let size = world.scene.model.len() + world.scene.everything(0.0).len();
        self.audience.expect_scene_of(size);
        self.world = Some(world);
        self.names = names;
        for status in ["Parsing world", "Finalizing nodes"] {
            self.audience.tell_watchers(protocol::loading(status, 100));
        }
        for id in self.audience.watchers() {
            self.show_world(id);
        }
        for id in std::mem::take(&mut self.newcomers) {
            self.tell_state(id);
        }
    }

    /// Lets a client watch.
    pub(crate) fn admit(&mut self, id: ClientId) {
        self.audience.watch(id);
        if self.world.is_none() {
            self.newcomers.push(id);
            self.audience.tell(id, reading());
            return;
        }
        self.show_world(id);
        self.tell_state(id);
    }

    /// Makes one step, whatever the mode.
    pub(crate) fn step(&mut self) {
        if self.world.is_some() {
            self.clock.step();
            self.show_changes();
        }
    }

    /// Goes back to time 0.
    pub(crate) fn reset(&mut self) {
        self.clock.reset();
        let Some(world) = &mut self.world else { return };
        for id in &world.scene.placed {
            self.audience.tell_watchers(protocol::visible(*id));
        }
        let everything = world.scene.everything(self.clock.now());
        self.audience.tell_watchers(protocol::update(&everything));
        self.audience.tell_watchers(protocol::RESET_FINISHED);
    }

    /// Shows what changed since the last time, to those who read fast enough.
    pub(crate) fn show_changes(&mut self) {
        let Some(world) = &mut self.world else { return };
        if self.audience.is_blind() {
            return;
        }
        let time = self.clock.now();
        let changes = protocol::update(&world.scene.changes(time));
        let everything = || protocol::update(&world.scene.everything(time));
        self.audience.show(changes, everything);
    }

    /// Shows everything to those who missed a change: time stands still, so they would not see it otherwise.
    pub(crate) fn catch_up(&mut self) {
        let Some(world) = &mut self.world else { return };
        let time = self.clock.now();
        let everything = || protocol::update(&world.scene.everything(time));
        self.audience.catch_up(everything);
    }

    fn tell_state(&mut self, id: ClientId) {
        let state = match self.clock.mode() {
            Mode::Pause => protocol::paused(self.clock.now()),
            Mode::RealTime => protocol::REAL_TIME.to_owned(),
            Mode::Fast => protocol::FAST.to_owned(),
        };
        self.audience.tell(id, state);
    }

    fn show_world(&mut self, id: ClientId) {
        let Some(world) = &mut self.world else { return };
        let everything = world.scene.everything(self.clock.now());
        self.audience.tell(id, protocol::world(&self.names));
        self.audience.tell(id, protocol::model(&world.scene.model));
        self.audience.tell(id, protocol::update(&everything));
        self.audience.tell(id, protocol::SCENE_COMPLETED);
    }
}

fn reading() -> String {
    protocol::loading("Reading world file ", 0)
}
