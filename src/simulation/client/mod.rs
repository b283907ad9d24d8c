//! A web client: the life of one simulation from its start message to the end of its connection.

mod lease;
pub mod outcome;
mod web_client;

pub use web_client::WebClient;
