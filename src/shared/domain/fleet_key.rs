//! The secret that all servers of a fleet share (`fleetKey`), and what it signs.

use std::fmt;

use ring::hmac;

/// The key of a fleet. It signs with HMAC-SHA256.
#[derive(Clone)]
pub struct FleetKey(hmac::Key);

/// The uses of the key. A signature for one is not valid for another.
#[derive(Debug, Clone, Copy)]
pub enum Purpose {
    /// A client's pass to a slot that is reserved for it.
    Pass,
    /// A client's place in the line.
    Ticket,
    /// The answer of a session server to the challenge of a simulation server.
    Link,
    /// An administrator's sign-in at one server.
    SignIn,
    /// An administrator's way from the session server to the page of a simulation server.
    Entry,
    /// What a session server reads from a simulation server for an administrator.
    Reading,
}

/// Length of a signature, in bytes.
pub const SIGNATURE: usize = 32;

impl FleetKey {
    /// The key of this secret.
    pub fn new(secret: &str) -> Self {
        Self(hmac::Key::new(hmac::HMAC_SHA256, secret.as_bytes()))
    }

    /// A key that no other process has, for a server without `fleetKey`.
    pub fn random() -> Self {
        Self(hmac::Key::new(hmac::HMAC_SHA256, &rand::random::<[u8; 32]>()))
    }

    /// Signs these parts.
    pub fn sign(&self, purpose: Purpose, parts: &[&[u8]]) -> [u8; SIGNATURE] {
        let mut signature = [0; SIGNATURE];
        signature.copy_from_slice(hmac::sign(&self.0, &joined(purpose, parts)).as_ref());
        signature
    }

    /// Whether this is the signature of these parts. Takes as long for a wrong one as for the right one.
    pub fn verifies(&self, purpose: Purpose, parts: &[&[u8]], signature: &[u8]) -> bool {
        hmac::verify(&self.0, &joined(purpose, parts), signature).is_ok()
    }
}

/// The bytes that are signed. Each part follows its length, so that no two lists of parts have the same bytes.
fn joined(purpose: Purpose, parts: &[&[u8]]) -> Vec<u8> {
    let mut bytes = vec![purpose as u8];
    for part in parts {
        bytes.extend(part.len().to_be_bytes());
        bytes.extend(*part);
    }
    bytes
}

impl fmt::Debug for FleetKey {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("FleetKey")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signature_is_valid_for_its_key_purpose_and_parts_only() {
        let key = FleetKey::new("a secret of a fleet");
        let parts: [&[u8]; 2] = [b"ab", b"c"];
        let signature = key.sign(Purpose::Pass, &parts);
        assert!(key.verifies(Purpose::Pass, &parts, &signature));
        assert!(!key.verifies(Purpose::Ticket, &parts, &signature));
        assert!(!key.verifies(Purpose::Pass, &[b"a", b"bc"], &signature));
        assert!(!key.verifies(Purpose::Pass, &parts, &signature[1..]));
        assert!(!FleetKey::random().verifies(Purpose::Pass, &parts, &signature));
        assert_eq!(format!("{key:?}"), "FleetKey");
    }
}
