//! The attachment of a connection to the session of its simulation, and how a client finds its session again.

mod sessions;

pub use sessions::{ClientAction, Connection, Resume, Sessions, ToClient, Token};
