//! The states of a session, and what it holds in each. Dropping a state gives everything back.

use actix::prelude::*;

use crate::shared::domain::ProjectUrl;
use crate::simulation::ends::{EndReason, Taken};
use crate::simulation::protocol::Mode;
use crate::simulation::slots::{Slot, SlotLease};
use crate::simulation::webots::{Stop, Webots};

/// The life of a simulation, as its session knows it.
pub enum State {
    /// Its client has asked for it.
    Asked {
        /// The URL as the client wrote it.
        url: String,
        /// How it is shown.
        mode: Mode,
    },
    /// Waiting for a place.
    Waiting {
        /// What was asked for.
        request: StartRequest,
        /// The place in the line.
        lease: SlotLease,
    },
    /// The project is being checked out; the job ends with the actor.
    CheckingOut {
        /// How it is shown.
        mode: Mode,
        /// The place and its port.
        slot: Slot,
    },
    /// Webots was started.
    Launched(WebotsHandle),
    /// The client was told the end.
    Over,
}

impl State {
    /// Tells how the simulation ends, before the state is dropped. What Webots has told of its own end comes first.
    pub fn end(&self, reason: EndReason, why: &str) {
        match self {
            Self::Waiting { lease, .. } | Self::CheckingOut { slot: Slot { lease, .. }, .. } => {
                lease.end(reason, why, Taken::default());
            }
            Self::Launched(WebotsHandle(webots)) => webots.do_send(Stop(reason)),
            Self::Asked { .. } | Self::Over => {}
        }
    }
}

/// The simulation that a client has asked for.
pub struct StartRequest {
    /// Where the world is.
    pub world: ProjectUrl,
    /// How it is shown.
    pub mode: Mode,
}

/// A running Webots. Dropping the handle stops it.
pub struct WebotsHandle(pub Addr<Webots>);

impl Drop for WebotsHandle {
    fn drop(&mut self) {
        self.0.do_send(Stop(EndReason::Left));
    }
}
