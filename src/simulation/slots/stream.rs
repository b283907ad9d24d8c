//! The streams of running simulations and their tokens: for simulations' clients, and for watching administrators.

use std::sync::{Arc, OnceLock};

use tokio::sync::Semaphore;

use super::simulation_record::{Access, Holder, SimulationRecord, SlotEvent};
use super::slot_pool::SlotPool;
use crate::simulation::attachment::Token;
use crate::simulation::simulated_time::SimulatedTime;
use crate::simulation::simulation_id::SimulationId;

/// The stream of a token.
#[derive(Debug, Clone)]
pub struct StreamTarget {
    /// The simulation.
    pub simulation: SimulationId,
    /// Its port on this machine.
    pub port: u16,
    /// Whether its Webots tells controllers if it has a world.
    pub answers_controllers: bool,
    /// Whether the token is a watcher's, which may change nothing.
    pub read_only: bool,
    /// Limits the WebSockets with this token. Each of them holds a permit.
    pub connections: Arc<Semaphore>,
    /// How fast the simulation runs.
    pub time: SimulatedTime,
    /// Why the server ends the simulation, once it does.
    pub ending: Arc<OnceLock<String>>,
}

/// A watcher's connection. Dropping it invalidates its token.
pub struct WatchGuard {
    token: Token,
    simulation: SimulationId,
    slots: Arc<SlotPool>,
}

impl SimulationRecord {
    /// Notifies the session if one watcher is connected: it is the first one, or the last one that leaves.
    fn notify_of_watchers(&self, is_watched: bool) {
        let accesses = self.stream().into_iter().flat_map(|stream| &stream.accesses);
        if accesses.filter(|access| access.holder == Holder::Watcher).count() == 1 {
            self.listener.do_send(SlotEvent::Watched(is_watched));
        }
    }
}

impl SlotPool {
    /// The stream of a token, if the token is valid.
    pub fn stream(&self, token: Token) -> Option<StreamTarget> {
        self.0.lock().records.values().find_map(|record| {
            let stream = record.stream()?;
            let access = stream.accesses.iter().find(|access| access.token == token)?;
            Some(StreamTarget {
                simulation: record.id,
                port: record.holding()?.port,
                answers_controllers: stream.answers_controllers,
                read_only: access.holder != Holder::Client,
                connections: Arc::clone(&access.connections),
                time: record.time.clone(),
                ending: Arc::clone(&record.ending),
            })
        })
    }

    /// Notifies the session that a viewer opens its stream.
    pub fn viewed(&self, simulation: SimulationId) {
        self.change(simulation, |record| record.listener.do_send(SlotEvent::Viewed));
    }

    /// Issues a token to watch a simulation; `None` if it has no stream.
    pub fn watch(&self, simulation: SimulationId) -> Option<Token> {
        let mut slots = self.0.lock();
        let stream = slots.records.get_mut(&simulation)?.stream_mut()?;
        let access = Access::new(Holder::Invited);
        let token = access.token;
        stream.accesses.push(access);
        Some(token)
    }

    /// Marks a watcher's token as used; `None` if it already was.
    pub fn start_watching(self: &Arc<Self>, simulation: SimulationId, token: Token) -> Option<WatchGuard> {
        let mut slots = self.0.lock();
        let record = slots.records.get_mut(&simulation)?;
        let mut accesses = record.stream_mut()?.accesses.iter_mut();
        let invited = accesses.find(|access| access.token == token && access.holder == Holder::Invited)?;
        invited.holder = Holder::Watcher;
        record.notify_of_watchers(true);
        Some(WatchGuard {
            token,
            simulation,
            slots: Arc::clone(self),
        })
    }
}

impl Drop for WatchGuard {
    fn drop(&mut self) {
        self.slots.change(self.simulation, |record| {
            record.notify_of_watchers(false);
            if let Some(stream) = record.stream_mut() {
                stream.accesses.retain(|access| access.token != self.token);
            }
        });
    }
}
