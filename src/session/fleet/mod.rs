//! The simulation servers: who is there, what each last told, and which one gets the next client.

mod changes;
mod fleet_status;
mod pick;
mod probe_error;
mod registry;
mod resolver;
mod server_monitor;
mod server_record;
mod subscribers;

pub use fleet_status::{FleetStatus, ServerStatus, State, StateChange, told_mean};
pub use pick::{NoServer, Pick};
pub use registry::{GetStatus, IsAvailable, Reconfigure, Registry, Subscribe};
pub use subscribers::{News, Subscribers};
