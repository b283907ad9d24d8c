//! Who is told of availability, and what each was told last. Part of the registry.

use std::collections::HashMap;

use actix::prelude::*;

/// Whether some simulation server can take a client.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub struct Availability(pub bool);

/// The subscribers: each is told a value once.
#[derive(Default)]
pub struct Subscribers {
    members: HashMap<u64, Subscriber>,
    last: u64,
    /// Those who could not be told the last change, for their mailboxes were full.
    late: Vec<u64>,
}

struct Subscriber {
    client: Recipient<Availability>,
    told: Option<bool>,
}

/// How telling somebody went.
#[derive(PartialEq, Eq)]
enum Told {
    Now,
    Later,
    Gone,
}

impl Subscribers {
    /// Takes in a subscriber and tells it the present value. Gives back its number.
    pub fn add(&mut self, client: Recipient<Availability>, available: bool) -> u64 {
        self.last += 1;
        let id = self.last;
        let mut subscriber = Subscriber { client, told: None };
        let told = subscriber.tell(available);
        if told == Told::Later {
            self.late.push(id);
        }
        if told != Told::Gone {
            self.members.insert(id, subscriber);
        }
        id
    }

    /// Forgets a subscriber.
    pub fn remove(&mut self, id: u64) {
        self.members.remove(&id);
    }

    /// How many there are.
    #[must_use]
    pub fn count(&self) -> usize {
        self.members.len()
    }

    /// Tells everybody who was told something else.
    pub fn tell(&mut self, available: bool) {
        self.late.clear();
        self.members.retain(|id, subscriber| {
            let told = subscriber.tell(available);
            if told == Told::Later {
                self.late.push(*id);
            }
            told != Told::Gone
        });
    }

    /// Tells those who could not be told before.
    pub fn tell_late(&mut self, available: bool) {
        for id in std::mem::take(&mut self.late) {
            match self.members.get_mut(&id).map(|subscriber| subscriber.tell(available)) {
                Some(Told::Later) => self.late.push(id),
                Some(Told::Gone) => self.remove(id),
                Some(Told::Now) | None => {}
            }
        }
    }
}

impl Subscriber {
    fn tell(&mut self, available: bool) -> Told {
        if self.told == Some(available) {
            return Told::Now;
        }
        match self.client.try_send(Availability(available)) {
            Ok(()) => {
                self.told = Some(available);
                Told::Now
            }
            Err(SendError::Full(_)) => Told::Later,
            Err(SendError::Closed(_)) => Told::Gone,
        }
    }
}
