//! A web client, and the session of its simulation from the request for it to its end.

mod resume;
mod session;
mod start;
mod web_client;

pub use session::Session;
pub use web_client::WebClient;
