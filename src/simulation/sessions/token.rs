//! The token with which a client resumes its session, or reaches the stream of its simulation.

use std::fmt;

/// Proves that a session or a stream belongs to a client. It never appears in a log or on a page of others; the one of a
/// session appears in no URL either. The time of a comparison tells nothing: it is one of numbers.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Token {
    /// The same for all tokens of a session.
    pub(super) number: u64,
    secret: u128,
}

/// Number of hexadecimal digits of the number.
const DIGITS: usize = 16;

impl Token {
    /// A new token.
    pub fn random() -> Self {
        Self { number: rand::random(), secret: rand::random() }
    }

    /// The next token of the same session.
    pub fn next(self) -> Self {
        Self { secret: rand::random(), ..self }
    }

    /// Parses a token of a client; `None` if it is invalid.
    pub fn parse(text: &str) -> Option<Self> {
        let is_hex = text.len() == 3 * DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let (number, secret) = text.split_at_checked(DIGITS).filter(|_| is_hex)?;
        Some(Self { number: u64::from_str_radix(number, 16).ok()?, secret: u128::from_str_radix(secret, 16).ok()? })
    }

    /// The token as text, only for its client.
    pub fn reveal(&self) -> String {
        format!("{:016x}{:032x}", self.number, self.secret)
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Token")
    }
}
