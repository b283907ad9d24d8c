//! The states of a session, and what it holds in each. Dropping a state releases that.

use actix::prelude::*;

use crate::shared::domain::ProjectUrl;
use crate::simulation::ends::{EndReason, Taken};
use crate::simulation::slots::{Slot, SlotLease};
use crate::simulation::webots::{Stop, Webots};

/// The life cycle of a simulation, as its session knows it.
pub enum State {
    /// Waiting for a slot.
    Waiting {
        /// The world.
        world: ProjectUrl,
        /// The lease, which holds the position in the queue.
        lease: SlotLease,
    },
    /// The project is being checked out for this slot; the job ends with the actor.
    CheckingOut(Slot),
    /// Webots was started.
    Launched(WebotsHandle),
    /// It holds nothing: it was not admitted yet, or its client got the last text.
    Over,
}

impl State {
    /// Reports how the simulation ends, before the state is dropped. Webots' own report takes precedence.
    pub fn end(&self, reason: EndReason, why: &str) {
        match self {
            Self::Waiting { lease, .. } | Self::CheckingOut(Slot { lease, .. }) => {
                lease.end(reason, why, Taken::default());
            }
            Self::Launched(WebotsHandle(webots)) => webots.do_send(Stop(reason)),
            Self::Over => {}
        }
    }
}

/// A running Webots. Dropping the handle stops it.
pub struct WebotsHandle(pub Addr<Webots>);

impl Drop for WebotsHandle {
    fn drop(&mut self) {
        self.0.do_send(Stop(EndReason::Left));
    }
}
