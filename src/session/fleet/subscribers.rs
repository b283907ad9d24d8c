//! Who is told the news, and what each was told last. Part of the registry and of each audience.

use std::collections::BTreeMap;

use actix::prelude::*;

/// What web clients are told without asking.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum News {
    /// Whether some simulation server can take a client.
    Availability(bool),
    /// The server ends.
    Closing,
    /// Nobody is there any more to tell it the news.
    Lost,
}

/// The subscribers: each is told the same news once.
#[derive(Default)]
pub struct Subscribers {
    /// In the order in which they came: what belongs to them lies in memory in that order too, mostly.
    members: BTreeMap<u64, Subscriber>,
    last: u64,
    /// Those who could not be told the last change, for their mailboxes were full.
    late: Vec<u64>,
}

struct Subscriber {
    client: Recipient<News>,
    told: Option<News>,
}

/// How telling somebody went.
#[derive(PartialEq, Eq)]
enum Told {
    Now,
    Later,
    Gone,
}

impl Subscribers {
    /// Takes in a subscriber and tells it what is known. Gives back its number.
    pub fn add(&mut self, client: Recipient<News>, news: Option<News>) -> u64 {
        self.last += 1;
        let id = self.last;
        let mut subscriber = Subscriber { client, told: None };
        let told = news.map_or(Told::Now, |news| subscriber.tell(news));
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

    /// Tells everybody who was told something else.
    pub fn tell(&mut self, news: News) {
        self.late.clear();
        self.tell_some(0, usize::MAX, news);
    }

    /// The same for so many of them, from this number on. Gives back where to go on, if there are more.
    pub fn tell_some(&mut self, from: u64, most: usize, news: News) -> Option<u64> {
        let mut gone = Vec::new();
        let mut members = self.members.range_mut(from..);
        for (id, subscriber) in members.by_ref().take(most) {
            match subscriber.tell(news) {
                Told::Now => {}
                Told::Later => self.late.push(*id),
                Told::Gone => gone.push(*id),
            }
        }
        let next = members.next().map(|(id, _)| *id);
        for id in gone {
            self.remove(id);
        }
        next
    }

    /// Tells those who could not be told before.
    pub fn tell_late(&mut self, news: News) {
        for id in std::mem::take(&mut self.late) {
            match self.members.get_mut(&id).map(|subscriber| subscriber.tell(news)) {
                Some(Told::Later) => self.late.push(id),
                Some(Told::Gone) => self.remove(id),
                Some(Told::Now) | None => {}
            }
        }
    }
}

impl Subscriber {
    fn tell(&mut self, news: News) -> Told {
        if self.told == Some(news) {
            return Told::Now;
        }
        match self.client.try_send(news) {
            Ok(()) => {
                self.told = Some(news);
                Told::Now
            }
            Err(SendError::Full(_)) => Told::Later,
            Err(SendError::Closed(_)) => Told::Gone,
        }
    }
}
