//! The attachment of a connection to the session of its simulation, and how a client finds its session again.

mod attachment;
mod sessions;
mod token;

pub use attachment::{ClientAction, Connection, ToClient};
pub use sessions::{Resume, Sessions};
pub use token::Token;
