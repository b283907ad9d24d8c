//! Which server gets the next client: the pure placement policy.
//!
//! A report of a simulation server is always old. Whoever goes by the reports alone sends a whole class to the one server
//! that looked best a moment ago. The [`LoadBalancer`] therefore counts each of its own placements as load at once, until the
//! reports show it.
//!
//! - `fleet`: the servers, and the choice between them; `policy`: what can be set;
//! - `order`: the servers sorted by load, so that a large fleet is as fast as a small one;
//! - `backend`: what is known of one server;
//! - `cost`: what a client costs a server, learned from its reports;
//! - `ejection`: which servers come last, because starts fail there;
//! - `peers`: how many clients other session servers send.
//!
//! Nothing here reads a clock or does any input or output: every call is told the time.
//! `docs/placement.md` explains the policy, and `cargo bench --bench placement` measures it.

mod backend;
mod cost;
mod ejection;
mod load_balancer;
mod policy;
mod ranking;
mod replicas;

pub use backend::{ClientCounts, LoadReport};
pub use load_balancer::LoadBalancer;
pub use policy::PlacementPolicy;
