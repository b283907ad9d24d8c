//! Messages to the slot pool.

use std::net::IpAddr;

use actix::prelude::*;

use super::present::{Present, Report};
use super::slot_error::SlotError;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::snapshot::Snapshot;

/// Requests a slot for a lease.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Acquire(pub Box<Present>);

/// A report of a lease's owner about its simulation.
#[derive(Message)]
#[rtype(result = "()")]
pub struct UpdateSimulation(pub SimulationId, pub Report);

/// Requests a snapshot of all simulations.
#[derive(Message)]
#[rtype(result = "Snapshot")]
pub struct GetSnapshot;

/// Releases a slot, or leaves the queue.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Release(pub SimulationId);

/// Stops the simulation that has this id now, and no other one; the answer is whether there is one.
#[derive(Message)]
#[rtype(result = "bool")]
pub struct StopOne {
    /// The id as it is written.
    pub id: String,
    /// Why, in words for its client.
    pub why: String,
}

/// Makes a slot count for another address of its client; the answer is why it may not.
#[derive(Message)]
#[rtype(result = "Result<(), SlotError>")]
pub struct Move {
    /// The id of the simulation.
    pub id: SimulationId,
    /// The client's current address, if it is known.
    pub address: Option<IpAddr>,
}
