//! The session server's configuration: every key, its default, and the rules between keys.

mod mail_address;
mod server_entry;
mod session_config;
mod timing;

pub use server_entry::ServerEntry;
pub use session_config::{AskName, Example, SessionConfig};
pub use timing::Timing;
