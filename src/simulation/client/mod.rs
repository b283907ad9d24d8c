//! A web client, and the session of its simulation from the request for it to its end.

mod attachment;
pub mod outcome;
pub mod quota;
mod session;
mod state;
mod web_client;

pub use session::Session;
pub use web_client::WebClient;
