//! Who is sent updates, and what each was sent last. Used by the registry and by each broadcaster.

use std::collections::BTreeMap;

use actix::prelude::*;

/// What web clients are told without asking.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum Update {
    /// Whether some simulation server can take a client.
    Availability(bool),
    /// The server stops.
    Closing,
    /// The broadcaster is gone: there will be no more updates.
    Lost,
}

/// The subscribers: each is sent an update only if it differs from the last one.
#[derive(Default)]
pub struct Subscribers {
    /// In the order in which they came, which is mostly the order of their data in memory.
    members: BTreeMap<u64, Subscriber>,
    last: u64,
    /// Those whose mailbox was full.
    pending: Vec<u64>,
}

struct Subscriber {
    recipient: Recipient<Update>,
    last: Option<Update>,
}

/// What became of an update for one subscriber.
#[derive(PartialEq, Eq)]
enum Delivery {
    Done,
    MailboxFull,
    Gone,
}

impl Subscribers {
    /// Adds a subscriber and sends it the current state, if there is one. Returns the subscriber's number.
    pub fn add(&mut self, recipient: Recipient<Update>, current: Option<Update>) -> u64 {
        self.last += 1;
        let id = self.last;
        let mut subscriber = Subscriber { recipient, last: None };
        let delivery = current.map_or(Delivery::Done, |update| subscriber.send(update));
        if delivery == Delivery::MailboxFull {
            self.pending.push(id);
        }
        if delivery != Delivery::Gone {
            self.members.insert(id, subscriber);
        }
        id
    }

    /// Removes a subscriber.
    pub fn remove(&mut self, id: u64) {
        self.members.remove(&id);
    }

    /// Sends an update to everybody.
    pub fn send(&mut self, update: Update) {
        self.pending.clear();
        self.send_batch(0, usize::MAX, update);
    }

    /// Sends an update to so many subscribers, beginning with this number. Returns where the next batch begins, if there
    /// is one.
    pub fn send_batch(&mut self, from: u64, size: usize, update: Update) -> Option<u64> {
        let mut gone = Vec::new();
        let mut members = self.members.range_mut(from..);
        for (id, subscriber) in members.by_ref().take(size) {
            match subscriber.send(update) {
                Delivery::Done => {}
                Delivery::MailboxFull => self.pending.push(*id),
                Delivery::Gone => gone.push(*id),
            }
        }
        let next = members.next().map(|(id, _)| *id);
        for id in gone {
            self.remove(id);
        }
        next
    }

    /// Sends the current state to those whose mailbox was full.
    pub fn retry(&mut self, current: Update) {
        for id in std::mem::take(&mut self.pending) {
            match self.members.get_mut(&id).map(|subscriber| subscriber.send(current)) {
                Some(Delivery::MailboxFull) => self.pending.push(id),
                Some(Delivery::Gone) => self.remove(id),
                Some(Delivery::Done) | None => {}
            }
        }
    }
}

impl Subscriber {
    fn send(&mut self, update: Update) -> Delivery {
        if self.last == Some(update) {
            return Delivery::Done;
        }
        match self.recipient.try_send(update) {
            Ok(()) => {
                self.last = Some(update);
                Delivery::Done
            }
            Err(SendError::Full(_)) => Delivery::MailboxFull,
            Err(SendError::Closed(_)) => Delivery::Gone,
        }
    }
}
