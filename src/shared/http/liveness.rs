//! Pings on a WebSocket, which detect a peer that has disconnected or does not read.

use std::time::{Duration, Instant};

use actix::prelude::*;
use actix_web_actors::ws::WebsocketContext;

/// The pings of one WebSocket connection.
///
/// A half-open connection reports no error; RFC 6455, section 5.5.2, defines pings for this. Each ping carries a random
/// number, and only a pong with that number counts. Answers to a peer that sends without reading would pile up in
/// memory, so the number of answers between two pongs is limited.
#[derive(Debug)]
pub struct Liveness {
    alive: Instant,
    asked: [u8; 8],
    answers: u32,
}

/// Limit of answers between two pongs.
const ANSWERS: u32 = 100;

impl Default for Liveness {
    /// Starts with a new connection.
    fn default() -> Self {
        Self {
            alive: Instant::now(),
            asked: rand::random(),
            answers: 0,
        }
    }
}

impl Liveness {
    /// Returns the content of the next ping.
    pub fn ping(&mut self) -> [u8; 8] {
        self.asked = rand::random();
        self.asked
    }

    /// Records a pong of the peer.
    pub fn pong(&mut self, content: &[u8]) {
        if content == self.asked {
            self.alive = Instant::now();
            self.answers = 0;
        }
    }

    /// Counts an answer. Returns whether it may be sent.
    pub fn may_answer(&mut self) -> bool {
        self.answers += 1;
        self.answers <= ANSWERS
    }
}

/// Pings a peer each `ping`, and stops the actor after `silence` without an answer; `of` returns the actor's liveness.
pub fn watch<A>(ctx: &mut WebsocketContext<A>, ping: Duration, silence: Duration, of: fn(&mut A) -> &mut Liveness)
where
    A: Actor<Context = WebsocketContext<A>>,
{
    ctx.run_interval(ping, move |actor, ctx| {
        let liveness = of(actor);
        let left = silence.saturating_sub(liveness.alive.elapsed());
        ctx.ping(&liveness.ping());
        // The timeout usually ends between two pings.
        if left < ping {
            ctx.run_later(left, move |actor, ctx| {
                if of(actor).alive.elapsed() >= silence {
                    log::info!("a client was silent for too long");
                    ctx.stop();
                }
            });
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_right_pong_is_a_sign_of_life() {
        let mut liveness = Liveness::default();
        while liveness.may_answer() {}
        liveness.pong(b"");
        assert!(!liveness.may_answer(), "a pong that nobody asked for proves nothing");
        let ping = liveness.ping();
        liveness.pong(&ping);
        assert!(liveness.may_answer());
    }
}
