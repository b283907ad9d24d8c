//! How a server starts, says that it is ready, logs, and stops.

mod logging;
pub mod notify;
pub mod permanent;
mod rotated_file;
mod shutdown;
pub mod start;
mod timestamp;

pub use logging::one_line;
pub use rotated_file::RotatedFile;
pub use shutdown::{Phase, Request, Signals, closing};
pub use timestamp::{seconds_since_1970, timestamp};
