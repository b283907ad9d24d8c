//! The request for a simulation server, and why it is refused.

use std::net::IpAddr;

use actix::prelude::*;

use crate::shared::domain::{ProjectUrl, ProjectUrlError, PublicAddress};
use crate::shared::text::client_text;

/// Requests the least loaded simulation server that accepts this world.
#[derive(Message, Debug)]
#[rtype(result = "Result<PublicAddress, PickError>")]
pub struct Pick {
    /// The world, if the client named one.
    pub world: Option<ProjectUrl>,
    /// The client's address, if it is known.
    pub from: Option<IpAddr>,
}

/// Why no simulation server is picked. The texts are those of the protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PickError {
    /// No server has room.
    #[error("Error: no simulation server available at the moment.")]
    Unavailable,
    /// No server accepts worlds of this repository.
    #[error("Error: no simulation server accepts {0}.")]
    NotAccepted(String),
    /// The URL does not name a world.
    #[error("Error: {0}")]
    InvalidWorld(#[from] ProjectUrlError),
}

impl PickError {
    /// The message for the client, safe to show.
    pub fn for_client(&self) -> String {
        client_text(&self.to_string())
    }
}
