//! What browsers and programs meet: paths, pages, and the WebSocket of a web client.

mod broadcaster;
mod page_routes;
pub mod pages;
mod queries;
mod routes;
mod status;
mod web_client;

pub use broadcaster::{Broadcaster, LocalBroadcaster};
pub use routes::configure;
