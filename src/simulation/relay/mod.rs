//! Relays a simulation's stream between a client and the port of its Webots on this machine: its WebSocket and the files
//! that Webots serves.

mod frames;
mod path;
mod stream;
mod stream_thread;
mod upstream;
mod watcher;
mod websocket;
mod world;

pub use path::parse_path;
pub use stream_thread::StreamThread;
pub use upstream::Upstream;
pub use websocket::connect;
#[cfg(test)]
pub use world::REQUEST;
pub use world::has_world;
