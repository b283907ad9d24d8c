//! What a Webots tells its client.

use actix::prelude::*;

/// What a client hears of its Webots.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum WebotsEvent {
    /// It listens on this port.
    Listening(u16),
    /// It lives.
    Heartbeat,
    /// It has given no sign of life for so many seconds.
    Hanging(u64),
    /// It has ended, and why.
    Exited(Exit),
}

/// Why a Webots has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exit {
    /// Whether it ended by itself and in order.
    pub clean: bool,
    /// In words, for the client.
    pub why: String,
}

/// Tells the client, and tells it the end in any case: also where the actor panics and is dropped.
pub struct LastWord {
    events: Recipient<WebotsEvent>,
    told: bool,
}

impl LastWord {
    /// Tells through this recipient.
    #[must_use]
    pub fn new(events: Recipient<WebotsEvent>) -> Self {
        Self { events, told: false }
    }

    /// Tells an event.
    pub fn tell(&mut self, event: WebotsEvent) {
        self.told |= matches!(event, WebotsEvent::Exited(_));
        // A heartbeat may be lost where a client can't keep up; how to reach Webots and its end may not.
        if matches!(event, WebotsEvent::Listening(_) | WebotsEvent::Exited(_)) {
            self.events.do_send(event);
        } else if let Err(lost) = self.events.try_send(event) {
            log::debug!("a client does not listen: {lost}");
        }
    }
}

impl Drop for LastWord {
    fn drop(&mut self) {
        if !self.told {
            let why = "The simulation was lost by a fault of this server".to_owned();
            self.tell(WebotsEvent::Exited(Exit { clean: false, why }));
        }
    }
}
