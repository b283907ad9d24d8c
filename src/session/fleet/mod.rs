//! The simulation servers: who is there, what each last told, and which one gets the next client.

mod changes;
mod fleet_status;
mod monitors;
mod name_monitor;
mod names;
mod pick;
mod probe_error;
mod quota;
mod registry;
mod resolver;
mod server_monitor;
mod server_record;
mod servers;

pub use fleet_status::{FleetStatus, NameStatus, ServerStatus, State, StateChange, displayed_mean_load};
pub use pick::{NoServer, Pick};
pub use registry::{GetStatus, Ping, Reconfigure, Registry};
pub use resolver::resolver;
