//! Whether the other end of a WebSocket still lives and reads.

use std::time::{Duration, Instant};

use actix::prelude::*;
use actix_web_actors::ws::WebsocketContext;

/// Watches one WebSocket connection.
///
/// A half-open connection never says that it is one; RFC 6455, section 5.5.2, has pings for this. Each ping carries a
/// number that can't be guessed, and only its return counts: a peer that sends without reading is as good as gone,
/// and would make answers pile up here. Between two pings it may therefore ask only so often.
#[derive(Debug)]
pub struct Liveness {
    alive: Instant,
    asked: [u8; 8],
    answers: u32,
}

/// How many answers a peer may ask for before it must answer a ping.
const ANSWERS: u32 = 100;

impl Liveness {
    /// A connection that was just opened.
    #[must_use]
    pub fn new() -> Self {
        Self { alive: Instant::now(), asked: rand::random(), answers: 0 }
    }

    /// The content of the next ping.
    pub fn ping(&mut self) -> [u8; 8] {
        self.asked = rand::random();
        self.asked
    }

    /// A pong came from the peer.
    pub fn pong(&mut self, content: &[u8]) {
        if content == self.asked {
            self.alive = Instant::now();
            self.answers = 0;
        }
    }

    /// Counts an answer; false when the peer has asked for too many without reading.
    #[must_use]
    pub fn may_answer(&mut self) -> bool {
        self.answers += 1;
        self.answers <= ANSWERS
    }

    /// Whether the peer has not answered a ping for so long.
    fn is_gone(&self, silence: Duration) -> bool {
        self.alive.elapsed() >= silence
    }
}

/// Pings a peer, and ends its actor when it is gone; `of` tells where the actor has its liveness.
pub fn watch<A>(ctx: &mut WebsocketContext<A>, ping: Duration, silence: Duration, of: fn(&mut A) -> &mut Liveness)
where
    A: Actor<Context = WebsocketContext<A>>,
{
    ctx.run_interval(ping, move |actor, ctx| {
        let liveness = of(actor);
        let left = silence.saturating_sub(liveness.alive.elapsed());
        ctx.ping(&liveness.ping());
        // The time is up between two pings, mostly.
        if left < ping {
            ctx.run_later(left, move |actor, ctx| {
                if of(actor).is_gone(silence) {
                    log::info!("a client was silent for too long");
                    ctx.stop();
                }
            });
        }
    });
}

impl Default for Liveness {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_right_pong_is_a_sign_of_life() {
        let mut liveness = Liveness::new();
        while liveness.may_answer() {}
        liveness.pong(b"");
        assert!(!liveness.may_answer(), "a pong that nobody asked for proves nothing");
        let ping = liveness.ping();
        liveness.pong(&ping);
        assert!(liveness.may_answer());
    }
}
