//! Whom to give the next client to: the pure placement policy.
//!
//! What a simulation server reports is always old, so whoever picks by the reports alone sends a whole class to the one
//! server that looked best a moment ago. The [`Fleet`] therefore counts each of its own placements as load at once, for as
//! long as the reports cannot show it, at the cost per client that it has learned from that server's reports.
//!
//! - `fleet`: the servers, and the choice between them; `policy`: what its owner can set;
//! - `order`: the servers by their effective load, so that a large fleet is as fast as a small one;
//! - `server`: what is known of one server;
//! - `cost`: how the cost of a client is learned;
//! - `allowance`: how many placements of one client address count; `unproven`: those of which only the load tells.
//!
//! Nothing here reads a clock or does any input or output: every call is told the time.
//! `docs/placement.md` explains the policy, and `cargo bench --bench placement` measures it.

mod allowance;
mod cost;
mod fleet;
mod order;
mod policy;
mod server;
mod unproven;

pub use fleet::Fleet;
pub use policy::Policy;
pub use server::{Instances, Report};
