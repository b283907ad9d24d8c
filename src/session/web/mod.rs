//! The interface to browsers and programs: routes, pages, and the WebSocket of a web client.

mod class_routes;
mod metrics;
mod page_routes;
pub mod pages;
mod refusal;
mod routes;
mod status;
mod web_client;

pub use routes::configure;
