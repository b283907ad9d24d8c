//! The attachment of a connection to the session of its simulation, and how a client finds its session again.

mod sessions;
mod token;

pub use sessions::{ClientAction, Connection, Resume, Sessions, ToClient};
pub use token::Token;
