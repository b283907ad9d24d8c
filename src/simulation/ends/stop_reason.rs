//! The reasons for which the end of a simulation can be requested. All others are observed.

use crate::shared::domain::{Failure, Reason};

/// Why the end of a simulation is requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopReason {
    /// Its client has left.
    Left,
    /// Its client was disconnected, and has not come back in time.
    Away,
    /// Its client is away for too long while others wait for a slot.
    MakesRoom,
    /// Nobody has opened its stream in time.
    NoViewer,
    /// It was kept ready without a client, and is not needed.
    Unneeded,
    /// An administrator has asked for it.
    Administrator,
    /// The server stops.
    ServerStopped,
    /// Its session has panicked.
    SessionLost,
}

impl From<StopReason> for Failure {
    /// The end, as pages and logs show it.
    fn from(reason: StopReason) -> Self {
        match reason {
            StopReason::Left => Self::new(Reason::Left, "Its client has gone"),
            StopReason::Away => Self::new(Reason::Away, "Its client has not come back"),
            StopReason::MakesRoom => Self::new(
                Reason::Away,
                "Others wait for a place, and its client has not come back",
            ),
            StopReason::NoViewer => Self::new(Reason::NoViewer, "Nobody has opened its 3D view"),
            StopReason::Unneeded => Self::new(Reason::Left, "It was kept ready, and no client has taken it"),
            StopReason::Administrator => Self::new(Reason::StoppedByAdministrator, "The administrator has stopped it"),
            StopReason::ServerStopped => Self::new(Reason::ServerStopped, "The server was stopped"),
            StopReason::SessionLost => lost(),
        }
    }
}

/// The end of a simulation whose actor has panicked.
pub fn lost() -> Failure {
    Failure::new(Reason::Lost, "The server has lost this simulation")
}
