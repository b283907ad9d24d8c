//! The simulation servers: their list, the last report of each, and the choice of one for the next client.

mod line_keeper;
mod name_table;
mod ready_requests;
mod ready_shares;
mod refusal;
mod registry;
mod resolver;
mod server_monitor;
mod server_record;
mod server_table;
mod slot_link;
mod state_history;

pub use line_keeper::{LineEvent, LineNews, StopWaiting, Wait};
pub use ready_requests::ReadyRequests;
pub use registry::{GetMonitors, GetStatus, GetWaiting, Pick, Reconfigure, Registry};
pub use server_monitor::GetRecords;
pub use server_record::{
    Answer, FleetStatus, Intake, NameStatus, ServerRecord, ServerState, ServerStatus, StateChange, StateName,
};
