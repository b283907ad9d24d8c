//! Start of a server, its readiness, its log, and signals.

mod logging;
mod open_files;
pub mod passing;
pub mod permanent;
mod rotated_file;
pub mod service_manager;
mod signals;
mod standard_output;
pub mod start;
mod timestamp;

pub use open_files::{limit_clients, raise_open_files};
pub use rotated_file::RotatedFile;
pub use signals::{Phase, ServerCommand, Signals, closing, leaving};
pub use start::AppError;
pub use timestamp::{milliseconds_since_1970, seconds_since_1970, timestamp, timestamp_in_milliseconds};
