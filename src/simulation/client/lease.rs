//! What a web client holds in each state of its simulation. Dropping it gives everything back.

use actix::prelude::*;

use crate::shared::domain::ProjectUrl;
use crate::simulation::places::Ticket;
use crate::simulation::protocol::Mode;
use crate::simulation::webots::{End, Webots};

/// The life of a simulation.
pub enum Stage {
    /// Nothing was asked for yet.
    Connected,
    /// A place was asked for; it may be granted before the ticket for it is here.
    Asking {
        /// The world.
        wanted: Wanted,
        /// The port, if it was granted already.
        granted: Option<u16>,
    },
    /// In the waiting line.
    Waiting {
        /// The world.
        wanted: Wanted,
        /// The place in the line.
        ticket: Ticket,
    },
    /// The project is being checked out; the job ends with the actor.
    CheckingOut {
        /// How it is shown.
        mode: Mode,
        /// The place and its port.
        place: (Ticket, u16),
    },
    /// Webots was started.
    Launched(Lease),
    /// The client was told the end.
    Over,
}

/// The world that is wanted.
pub struct Wanted {
    /// Where it is.
    pub world: ProjectUrl,
    /// How it is shown.
    pub mode: Mode,
}

/// A running Webots: dropping it asks Webots to end.
pub struct Lease(pub Addr<Webots>);

impl Drop for Lease {
    fn drop(&mut self) {
        self.0.do_send(End);
    }
}
