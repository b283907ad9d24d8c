//! The token with which a client resumes its session, or reaches the stream of its simulation.

use std::fmt;

use subtle::ConstantTimeEq;

/// Identifies a session, and proves that it belongs to the client. It never appears in a log or on a page of others; the one of a session
/// appears in no URL either.
#[derive(Clone, Copy)]
pub struct Token {
    number: u64,
    secret: [u8; 16],
}

/// Number of hexadecimal digits of the session's number.
const DIGITS: usize = 16;

impl Token {
    /// A new token for the session with this number.
    pub fn new(number: u64) -> Self {
        Self { number, secret: rand::random() }
    }

    /// Parses a token of a client; `None` if it is invalid.
    pub fn parse(text: &str) -> Option<Self> {
        let is_hex = text.len() == 3 * DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let (number, secret) = text.split_at_checked(DIGITS).filter(|_| is_hex)?;
        let secret = u128::from_str_radix(secret, 16).ok()?.to_be_bytes();
        Some(Self { number: u64::from_str_radix(number, 16).ok()?, secret })
    }

    /// The number of the session.
    pub fn number(&self) -> u64 {
        self.number
    }

    /// The token as text, only for its client.
    pub fn reveal(&self) -> String {
        format!("{:016x}{:032x}", self.number, u128::from_be_bytes(self.secret))
    }
}

impl PartialEq for Token {
    /// Compares the secrets in constant time.
    fn eq(&self, other: &Self) -> bool {
        self.number == other.number && self.secret.ct_eq(&other.secret).into()
    }
}

impl Eq for Token {}

impl fmt::Debug for Token {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Token")
    }
}
