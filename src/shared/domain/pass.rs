//! A pass: what a client shows to a simulation server when its turn in the line has come.

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use serde::{Deserialize, Serialize};

use super::fleet_key::{FleetKey, Purpose, SIGNATURE};
use super::project_url::ProjectUrl;

/// One run of a simulation server: a random number from its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ServerRun(pub u64);

/// A slot that a simulation server has reserved: a random number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ReservationId(pub u64);

/// The right to a reserved slot, for one world. Only the simulation server knows whether the reservation still holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pass {
    /// The server that has reserved the slot.
    pub server: ServerRun,
    /// The reservation.
    pub reservation: ReservationId,
}

/// Length of a number in a pass, in bytes.
const NUMBER: usize = size_of::<u64>();

impl Pass {
    /// The pass as text, for a client that starts this world.
    pub fn write(self, key: &FleetKey, world: &ProjectUrl) -> String {
        let signature = key.sign(Purpose::Pass, &[&self.numbers(), world.to_string().as_bytes()]);
        let mut bytes = self.numbers().to_vec();
        bytes.extend(signature);
        URL_SAFE_NO_PAD.encode(bytes)
    }

    /// Reads the pass of a client that starts this world; `None` if it was not signed with this key for that.
    pub fn read(text: &str, key: &FleetKey, world: &ProjectUrl) -> Option<Self> {
        let mut bytes = [0; 2 * NUMBER + SIGNATURE];
        let length = URL_SAFE_NO_PAD.decode_slice(text, &mut bytes).ok()?;
        let (numbers, signature) = bytes.get(..length)?.split_at_checked(2 * NUMBER)?;
        let is_valid = key.verifies(Purpose::Pass, &[numbers, world.to_string().as_bytes()], signature);
        let (server, reservation) = numbers.split_at_checked(NUMBER).filter(|_| is_valid)?;
        Some(Self {
            server: ServerRun(u64::from_be_bytes(server.try_into().ok()?)),
            reservation: ReservationId(u64::from_be_bytes(reservation.try_into().ok()?)),
        })
    }

    /// The server that has given a pass, as the pass says, which is not verified.
    pub fn server_of(text: &str) -> Option<ServerRun> {
        let bytes = URL_SAFE_NO_PAD.decode(text).ok()?;
        Some(ServerRun(u64::from_be_bytes(*bytes.first_chunk()?)))
    }

    fn numbers(self) -> [u8; 2 * NUMBER] {
        let mut numbers = [0; 2 * NUMBER];
        numbers[..NUMBER].copy_from_slice(&self.server.0.to_be_bytes());
        numbers[NUMBER..].copy_from_slice(&self.reservation.0.to_be_bytes());
        numbers
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn world(name: &str) -> ProjectUrl {
        ProjectUrl::parse(&format!("https://github.com/lab/arm/blob/main/worlds/{name}.wbt")).unwrap()
    }

    #[test]
    fn a_pass_is_valid_for_its_key_and_world() {
        let key = FleetKey::new("a secret of a fleet");
        let pass = Pass {
            server: ServerRun(7),
            reservation: ReservationId(u64::MAX),
        };
        let text = pass.write(&key, &world("a"));
        assert_eq!(Pass::read(&text, &key, &world("a")), Some(pass));
        assert_eq!(Pass::server_of(&text), Some(pass.server));
        assert_eq!(Pass::read(&text, &key, &world("b")), None);
        assert_eq!(Pass::read(&text, &FleetKey::random(), &world("a")), None);
        for wrong in ["", "x", text.strip_suffix(|_| true).unwrap(), &format!("{text}AAAA")] {
            assert_eq!(Pass::read(wrong, &key, &world("a")), None, "{wrong:?}");
        }
    }

    proptest! {
        #[test]
        fn no_changed_pass_is_valid(server: u64, reservation: u64, at in 0..64_usize, letter in "[A-Za-z0-9_-]") {
            let key = FleetKey::new("a secret of a fleet");
            let pass = Pass { server: ServerRun(server), reservation: ReservationId(reservation) };
            let text = pass.write(&key, &world("a"));
            let mut changed = text.clone();
            changed.replace_range(at..=at, &letter);
            prop_assert!(changed == text || Pass::read(&changed, &key, &world("a")).is_none());
        }

        #[test]
        fn any_text_is_read(text: String) {
            prop_assert_eq!(Pass::read(&text, &FleetKey::random(), &world("a")), None);
        }
    }
}
