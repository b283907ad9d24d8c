//! Relays a simulation's stream between a client and the port of its Webots on this machine: its WebSocket and the files
//! that Webots serves.

mod file;
mod path;
mod upstream;
mod watching;
mod websocket;

pub use file::fetch;
pub use path::split;
pub use upstream::Upstream;
pub use websocket::connect;
