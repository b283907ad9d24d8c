//! How simulations have ended: counted, in `simulations.csv`, on the monitor, and with their output in files.

pub mod csv;
mod ended;
mod ends;
mod kept_output;
mod stop_reason;

pub use ended::{End, Ended, ResourceUsage};
pub use ends::Ends;
pub use kept_output::{FOLDER_OF_RUNNING, last_lines, output_file};
pub use stop_reason::{StopReason, lost};
