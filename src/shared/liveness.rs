//! Whether the other end of a WebSocket still lives and reads.

use std::time::{Duration, Instant};

/// Watches one WebSocket connection.
///
/// A peer that is silent for too long is gone: a half-open connection never says so by itself (RFC 6455, section
/// 5.5.2, has pings for this). A peer that asks without reading the answers would make them pile up here: between two
/// signs of life it may ask only so often.
#[derive(Debug)]
pub struct Liveness {
    heard: Instant,
    answers: u32,
}

/// How many answers a peer may ask for before it must answer a ping.
const ANSWERS: u32 = 100;

impl Liveness {
    /// A connection that was just opened.
    #[must_use]
    pub fn new() -> Self {
        Self { heard: Instant::now(), answers: 0 }
    }

    /// Something came from the peer.
    pub fn heard(&mut self) {
        self.heard = Instant::now();
    }

    /// The peer has answered a ping: it reads what it is sent.
    pub fn pong(&mut self) {
        self.heard();
        self.answers = 0;
    }

    /// Counts an answer; false when the peer has asked for too many without reading.
    #[must_use]
    pub fn may_answer(&mut self) -> bool {
        self.answers += 1;
        self.answers <= ANSWERS
    }

    /// Whether the peer has been silent for longer than this.
    #[must_use]
    pub fn is_gone(&self, silence: Duration) -> bool {
        self.heard.elapsed() > silence
    }
}

impl Default for Liveness {
    fn default() -> Self {
        Self::new()
    }
}
