//! A web client: the life of one simulation from its start message to the end of its connection.

pub mod outcome;
pub mod quota;
mod state;
mod web_client;

pub use web_client::WebClient;
