//! Which server gets the next client: the pure placement policy.
//!
//! A report of a simulation server is always old. Scheduling by reports alone sends a whole class to the server with
//! the lowest last report. The [`LoadBalancer`] therefore counts each of its own placements as load at once, until the
//! reports show it.
//!
//! - `load_balancer`: the servers sorted by load, and the choice between them; `policy`: its parameters;
//! - `backend`: what is known of one server;
//! - `cost`: what a client costs a server, learned from its reports;
//! - `ejection`: which servers come last, because their starts fail;
//! - `ready_worlds`: what servers keep ready, and which has to keep how much;
//! - `replicas`: how many clients other session servers send.
//!
//! Nothing here reads a clock or does I/O: the caller passes the time.
//! `docs/placement.md` explains the policy, and `cargo bench --bench placement` measures it.

mod backend;
mod cost;
mod ejection;
mod load_balancer;
mod policy;
mod ready_worlds;
mod replicas;

pub use load_balancer::LoadBalancer;
pub use policy::PlacementPolicy;
pub use ready_worlds::{ReadyWorlds, shares};
