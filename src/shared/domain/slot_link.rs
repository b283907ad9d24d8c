//! The messages between a session server and a simulation server about slots for the line: JSON on a WebSocket.
//!
//! The simulation server begins with a [`Hello`], whose challenge the session server answers with a [`Proof`]. Then the
//! session server sends [`Wishes`], each of which replaces the one before, and the simulation server sends [`Offers`]:
//! one in answer to each, and one whenever it reserves a slot. Beside that, the session server may send a
//! [`KeepReady`](super::KeepReady), if the [`Hello`] says so.

use std::net::IpAddr;

use serde::{Deserialize, Serialize};

use super::fleet_key::{FleetKey, Purpose};
use super::pass::{ReservationId, ServerRun};
use super::project_url::ProjectUrl;

/// Longest message of a session server, in bytes: a list of a thousand worlds, with URLs of common lengths.
pub const MAX_LINK_MESSAGE: usize = 256 * 1024;

/// The first message of a simulation server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Hello {
    /// A random number that the session server signs.
    pub challenge: u64,
    /// This run of the simulation server.
    pub server: ServerRun,
    /// Seconds for which a reservation holds.
    pub pass: f64,
    /// Whether it keeps simulations ready on request ([`KeepReady`](super::KeepReady)).
    #[serde(default)]
    pub keeps_ready: bool,
    /// Whether it tells its simulations, too (`roster`).
    #[serde(default)]
    pub roster: bool,
}

/// The first message of a session server: it has the fleet's key.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Proof {
    /// The signature of the challenge.
    pub proof: Vec<u8>,
}

/// A client that wants a slot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Wish {
    /// The number of its ticket.
    pub ticket: u64,
    /// How long it has waited, in milliseconds.
    pub waited: u64,
    /// Its address, which has a share of the slots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<IpAddr>,
    /// Its user, who has a share of the slots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// Its world, of which one may be ready.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub world: Option<ProjectUrl>,
}

/// The clients that want slots of a simulation server.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Wishes {
    /// A number that grows with each message.
    pub number: u64,
    /// The first of them, in the order of the line.
    pub first: Vec<Wish>,
    /// Number of all of them.
    pub all: u32,
    /// Reservations that nobody uses.
    #[serde(default)]
    pub back: Vec<ReservationId>,
}

/// A slot that is reserved for a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Offer {
    /// The number of its ticket.
    pub ticket: u64,
    /// The reservation.
    pub reservation: ReservationId,
}

/// Slots that a simulation server has reserved.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Offers {
    /// The number of the last wishes that were received.
    pub number: u64,
    /// The reservations that are new.
    pub offers: Vec<Offer>,
    /// Number of slots that are free now.
    pub free: u32,
    /// Reservations whose clients have come.
    #[serde(default)]
    pub used: Vec<ReservationId>,
    /// How long each client at its own door has waited, in milliseconds.
    #[serde(default)]
    pub queue: Vec<u64>,
    /// Of those whose clients want slots, the ones that are passed over for now.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub passed: Vec<PassedOver>,
}

/// Clients that are passed over: they have their share of the slots, or have let too many reservations expire.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum PassedOver {
    /// Those of an address.
    Address(IpAddr),
    /// Those of a user.
    User(String),
}

impl Hello {
    /// The answer of a server that has the key.
    pub fn prove(&self, key: &FleetKey) -> Proof {
        Proof {
            proof: key
                .sign(Purpose::Link, &self.signed().each_ref().map(<[u8; 8]>::as_slice))
                .to_vec(),
        }
    }

    /// Whether the sender of this answer has the key.
    pub fn is_proved(&self, key: &FleetKey, proof: &Proof) -> bool {
        let parts = self.signed();
        key.verifies(Purpose::Link, &parts.each_ref().map(<[u8; 8]>::as_slice), &proof.proof)
    }

    fn signed(&self) -> [[u8; 8]; 2] {
        [self.challenge.to_be_bytes(), self.server.0.to_be_bytes()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_key_proves_itself_and_only_for_one_challenge() {
        let hello = Hello {
            challenge: 5,
            server: ServerRun(6),
            pass: 10.0,
            keeps_ready: true,
            roster: true,
        };
        let key = FleetKey::new("a secret of a fleet");
        let proof = hello.prove(&key);
        assert!(hello.is_proved(&key, &proof));
        assert!(!hello.is_proved(&FleetKey::random(), &proof));
        let other = Hello {
            challenge: 6,
            ..hello.clone()
        };
        assert!(!other.is_proved(&key, &proof));
        let elsewhere = Hello {
            server: ServerRun(7),
            ..hello
        };
        assert!(!elsewhere.is_proved(&key, &proof));
    }
}
