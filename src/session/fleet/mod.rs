//! The simulation servers: their list, the last report of each, and the choice of one for the next client.

mod name_table;
mod refusal;
mod registry;
mod resolver;
mod server_monitor;
mod server_record;
mod server_table;
mod state_history;

pub use registry::{GetStatus, Pick, Reconfigure, Registry};
pub use server_record::{
    Answer, FleetStatus, Intake, NameStatus, ServerRecord, ServerState, ServerStatus, StateChange, StateName,
};
