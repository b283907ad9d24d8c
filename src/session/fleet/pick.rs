//! What a client asks the registry for, and how it is told that there is none.

use std::net::IpAddr;

use actix::prelude::*;

use crate::shared::domain::PublicAddress;
use crate::shared::domain::{NoProject, ProjectUrl};

/// Asks for a simulation server: the least loaded that will run this world.
#[derive(Message, Debug)]
#[rtype(result = "Result<PublicAddress, NoServer>")]
pub struct Pick {
    /// The world, where one is named.
    pub world: Option<ProjectUrl>,
    /// The client's address, where it is known.
    pub from: Option<IpAddr>,
}

/// No simulation server is given. The words are those of the protocol.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoServer {
    /// None has room.
    #[error("Error: no simulation server available at the moment.")]
    Unavailable,
    /// None runs worlds of this repository.
    #[error("Error: no simulation server accepts {0}.")]
    NotAccepted(String),
    /// The world's URL is none.
    #[error("Error: {0}")]
    NoWorld(NoProject),
}

impl Pick {
    /// Reads what a client of this address wants: nothing in particular, or a world.
    ///
    /// # Errors
    /// When the URL is none.
    pub fn parse(world: Option<&str>, from: Option<IpAddr>) -> Result<Self, NoServer> {
        let world = world.filter(|text| !text.is_empty()).map(ProjectUrl::parse).transpose();
        world.map(|world| Self { world, from }).map_err(NoServer::NoWorld)
    }
}
