//! Messages to the slot pool.

use actix::prelude::*;

use super::present::Present;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::Snapshot;

/// Requests a slot for a lease.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Acquire(pub Box<Present>);

/// Changes the record of a simulation.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Update(pub SimulationId, pub Box<dyn FnOnce(&mut Present) + Send>);

/// Requests a snapshot of all simulations.
#[derive(Message)]
#[rtype(result = "Snapshot")]
pub struct GetSnapshot;

/// Releases a slot, or leaves the queue.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Release(pub SimulationId);

/// Stops the simulation that has this id now, and no other one; the answer is whether there is one.
#[derive(Message)]
#[rtype(result = "bool")]
pub struct StopOne {
    /// The id as it is written.
    pub id: String,
    /// Why, in words for its client.
    pub why: String,
}
