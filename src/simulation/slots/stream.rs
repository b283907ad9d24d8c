//! The streams of running simulations, and the tokens that lead to them: those of simulations' clients, and those of
//! watching administrators.

use std::sync::Arc;
use std::time::Instant;

use super::access::{Access, Holder};
use super::present::Present;
use super::slot_event::SlotEvent;
use super::slot_lease::SlotLease;
use super::slot_pool::SlotPool;
use crate::simulation::sessions::Token;
use crate::simulation::simulation_id::SimulationId;

/// The stream that a token leads to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StreamTarget {
    /// The simulation.
    pub simulation: SimulationId,
    /// Its port on this machine.
    pub port: u16,
    /// Whether the token is a watcher's, which may change nothing.
    pub read_only: bool,
}

/// A watcher's connection. Dropping it invalidates its token.
pub struct WatchGuard {
    token: Token,
    simulation: SimulationId,
    slots: Arc<SlotPool>,
}

impl Present {
    /// Notifies the session if one watcher is connected: the first one has come, or the last one leaves.
    fn notify_of_watchers(&self, is_watched: bool) {
        if self.accesses.iter().filter(|access| access.holder == Holder::Watcher).count() == 1 {
            self.listener.do_send(SlotEvent::Watched(is_watched));
        }
    }
}

impl SlotLease {
    /// Opens the stream of the simulation, until its end is reported. Returns the token for its client.
    pub fn open_stream(&self) -> Token {
        let token = Token::new(rand::random());
        self.change(|present| present.accesses.push(Access { token, holder: Holder::Client }));
        token
    }
}

impl SlotPool {
    /// The stream of a token, if the token is valid.
    pub fn stream(&self, token: &Token) -> Option<StreamTarget> {
        self.slots().present.values().find_map(|one| {
            let access = one.accesses.iter().find(|access| access.token == *token && access.is_valid())?;
            let read_only = access.holder != Holder::Client;
            Some(StreamTarget { simulation: one.shown.id, port: one.shown.port?, read_only })
        })
    }

    /// Issues a token to watch a simulation; `None` if it has no stream.
    pub fn watch(&self, simulation: SimulationId) -> Option<Token> {
        let mut slots = self.slots();
        let accesses = &mut slots.present.get_mut(&simulation)?.accesses;
        accesses.retain(Access::is_valid);
        if accesses.is_empty() {
            return None;
        }
        let token = Token::new(rand::random());
        accesses.push(Access { token, holder: Holder::Invited(Instant::now()) });
        Some(token)
    }

    /// Marks a watcher's token as used; `None` if it already was.
    pub fn start_watching(self: &Arc<Self>, simulation: SimulationId, token: Token) -> Option<WatchGuard> {
        let mut slots = self.slots();
        let present = slots.present.get_mut(&simulation)?;
        let access = present.accesses.iter_mut().find(|access| access.token == token)?;
        if !matches!(access.holder, Holder::Invited(_)) {
            return None;
        }
        access.holder = Holder::Watcher;
        present.notify_of_watchers(true);
        Some(WatchGuard { token, simulation, slots: Arc::clone(self) })
    }
}

impl Drop for WatchGuard {
    fn drop(&mut self) {
        self.slots.change(self.simulation, |present| {
            present.notify_of_watchers(false);
            present.accesses.retain(|access| access.token != self.token);
        });
    }
}

#[cfg(test)]
mod tests {
    use actix::prelude::*;

    use super::super::access::TOKEN_TIMEOUT;
    use super::*;
    use crate::shared::domain::ProjectUrl;
    use crate::shared::http::{Metrics, Peer};
    use crate::simulation::client_identity::ClientIdentity;
    use crate::simulation::ends::{EndReason, Ends, Taken};

    struct Session;

    impl Actor for Session {
        type Context = Context<Self>;
    }

    impl Handler<SlotEvent> for Session {
        type Result = ();

        fn handle(&mut self, _: SlotEvent, _: &mut Self::Context) {}
    }

    #[actix_rt::test]
    async fn a_token_for_watching_that_was_not_used_for_a_minute_is_none() {
        let ends = Ends::start("/nonexistent".into(), String::new(), &Metrics::default()).unwrap();
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let slots = SlotPool::new(port..=port, 1, None, None, ends);
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/arm.wbt").unwrap();
        let (id, client) =
            (SimulationId::next(), (Peer::Proxy(std::net::Ipv4Addr::LOCALHOST.into()), ClientIdentity::default()));
        let lease = SlotLease::acquire(&slots, id, Session.start().recipient(), &world, client).unwrap();
        assert!(slots.watch(id).is_none(), "it has no stream yet");
        let token = lease.open_stream();
        assert_eq!(slots.stream(&token), Some(StreamTarget { simulation: id, port, read_only: false }));
        assert_eq!(slots.stream(&Token::new(token.number())), None, "the same number with another secret");
        let [used, unused] = [(); 2].map(|()| slots.watch(id).unwrap());
        let _watching = slots.start_watching(id, used).unwrap();
        assert!(slots.start_watching(id, used).is_none() && slots.start_watching(id, token).is_none());
        lease.change(|present| {
            for access in &mut present.accesses {
                if let Holder::Invited(at) = &mut access.holder {
                    *at = Instant::now().checked_sub(TOKEN_TIMEOUT).unwrap();
                }
            }
        });
        assert!(slots.stream(&used).unwrap().read_only);
        assert_eq!(slots.stream(&unused), None);
        lease.end(EndReason::Left, "", Taken::default());
        assert!([token, used].iter().all(|token| slots.stream(token).is_none()));
    }
}
