//! A ticket: what a client keeps of its place in the line, signed, so that no server has to.

use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;

use super::waiting_line::Place;
use crate::shared::domain::{FleetKey, Purpose, SIGNATURE};

/// A place in the line, and when the ticket for it was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ticket {
    /// The place.
    pub place: Place,
    /// When it was sent, in milliseconds since 1970.
    pub sent: u64,
}

/// Length of a number in a ticket, in bytes.
const NUMBER: usize = size_of::<u64>();

impl Ticket {
    /// Interval between two tickets of a client that waits.
    pub const RENEWAL: Duration = Duration::from_secs(30);
    /// How long a ticket is valid after it was sent.
    pub const VALIDITY: Duration = Duration::from_mins(1);

    /// The ticket as text, for the client.
    pub fn write(self, key: &FleetKey) -> String {
        let numbers = [self.place.since, self.place.number, self.sent].map(u64::to_be_bytes);
        let mut bytes = numbers.as_flattened().to_vec();
        bytes.extend(key.sign(Purpose::Ticket, &[numbers.as_flattened()]));
        URL_SAFE_NO_PAD.encode(bytes)
    }

    /// Reads the ticket of a client; `None` if it was not signed with this key, or is too old at `now`.
    pub fn read(text: &str, key: &FleetKey, now: u64) -> Option<Self> {
        let mut bytes = [0; 3 * NUMBER + SIGNATURE];
        let length = URL_SAFE_NO_PAD.decode_slice(text, &mut bytes).ok()?;
        let (numbers, signature) = bytes.get(..length)?.split_at_checked(3 * NUMBER)?;
        if !key.verifies(Purpose::Ticket, &[numbers], signature) {
            return None;
        }
        let mut numbers = numbers
            .chunks_exact(NUMBER)
            .filter_map(|bytes| Some(u64::from_be_bytes(bytes.try_into().ok()?)));
        let place = Place {
            since: numbers.next()?,
            number: numbers.next()?,
        };
        let sent = numbers.next()?;
        (u128::from(now.saturating_sub(sent)) <= Self::VALIDITY.as_millis()).then_some(Self { place, sent })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const TICKET: Ticket = Ticket {
        place: Place {
            since: 1_000,
            number: 77,
        },
        sent: 50_000,
    };

    #[test]
    fn a_ticket_is_valid_for_a_minute_after_it_was_sent() {
        let key = FleetKey::new("a secret of a fleet");
        let text = TICKET.write(&key);
        assert_eq!(Ticket::read(&text, &key, 110_000), Some(TICKET));
        assert_eq!(Ticket::read(&text, &key, 110_001), None);
        // Clocks of session servers differ.
        assert_eq!(Ticket::read(&text, &key, 40_000), Some(TICKET));
        assert_eq!(Ticket::read(&text, &FleetKey::random(), 50_000), None);
    }

    proptest! {
        #[test]
        fn no_changed_ticket_is_valid(at in 0..74_usize, letter in "[A-Za-z0-9_-]") {
            let key = FleetKey::new("a secret of a fleet");
            let text = TICKET.write(&key);
            let mut changed = text.clone();
            changed.replace_range(at..=at, &letter);
            prop_assert!(changed == text || Ticket::read(&changed, &key, 50_000).is_none());
        }

        #[test]
        fn any_text_is_read(text: String) {
            prop_assert_eq!(Ticket::read(&text, &FleetKey::random(), 0), None);
        }
    }
}
