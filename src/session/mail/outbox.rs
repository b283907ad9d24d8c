//! Decides when a mail that failed is tried again, and when it is given up. Pure; time is passed in.
//!
//! Entries that wait go together: what became due while the mail server was away joins the next try, and a newer
//! entry of the same server and topic takes the place of the older, so that no line waits behind another.

use std::time::{Duration, Instant};

use super::notices::Entry;

/// How failing mails are treated.
#[derive(Debug, Clone, Copy)]
pub struct Persistence {
    /// The wait after the first failure; it doubles with each.
    pub retry: Duration,
    /// After so long of tries an entry is given up.
    pub patience: Duration,
    /// How many entries wait at most; the oldest make room.
    pub most: usize,
}

impl Persistence {
    /// The longest wait between two tries.
    fn longest(self) -> Duration {
        self.retry.max(self.patience / 6)
    }
}

/// Entries that are to be mailed.
#[derive(Debug)]
pub struct Outbox {
    persistence: Persistence,
    waiting: Vec<Waiting>,
    /// The wait after the next failure.
    wait: Duration,
    not_before: Option<Instant>,
}

/// An entry on its way.
#[derive(Debug, Clone)]
struct Waiting {
    entry: Entry,
    first_try: Option<Instant>,
}

/// What one try mails.
#[derive(Debug, Clone)]
pub struct Batch(Vec<Waiting>);

impl Batch {
    /// The entries in the order of the mail: by event, then by server.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> {
        let mut entries: Vec<&Entry> = self.0.iter().map(|waiting| &waiting.entry).collect();
        entries.sort_by_key(|entry| (entry.notice.event, entry.notice.server.clone()));
        entries.into_iter()
    }
}

/// Whether a failure may pass by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// Such as a refused connection.
    Passing,
    /// Such as a wrong password. It is tried again too, for only a mail can tell the administrator, and a password, a
    /// full mailbox or a relay's rules are often put right within the hour; but with the longest wait from the start,
    /// so that no account is locked for too many wrong logins.
    Lasting,
}

impl Outbox {
    /// An empty outbox.
    #[must_use]
    pub fn new(persistence: Persistence) -> Self {
        Self { persistence, waiting: Vec::new(), wait: persistence.retry, not_before: None }
    }

    /// Takes in entries that are to be mailed. Gives back how many of the oldest had to make room.
    pub fn put(&mut self, entries: Vec<Entry>) -> usize {
        for entry in entries {
            self.join(entry);
        }
        let surplus = self.waiting.len().saturating_sub(self.persistence.most);
        self.waiting.drain(..surplus).count()
    }

    /// When the next try is due; with nothing to mail, never.
    #[must_use]
    pub fn due(&self, now: Instant) -> Option<Instant> {
        (!self.waiting.is_empty()).then(|| self.not_before.unwrap_or(now))
    }

    /// Takes out what is to be tried now. Its fate is to be told by [`Self::succeeded`] or [`Self::failed`].
    pub fn take(&mut self, now: Instant) -> Option<Batch> {
        self.due(now).filter(|due| *due <= now)?;
        let mut batch = std::mem::take(&mut self.waiting);
        for waiting in &mut batch {
            waiting.first_try.get_or_insert(now);
        }
        Some(Batch(batch))
    }

    /// The last try went well.
    pub fn succeeded(&mut self) {
        self.wait = self.persistence.retry;
        self.not_before = None;
    }

    /// The last try failed. Gives back the entries that are given up.
    pub fn failed(&mut self, batch: Batch, failure: Failure, now: Instant) -> Vec<Entry> {
        let patience = self.persistence.patience;
        let end = |waiting: &Waiting| waiting.first_try.unwrap_or(now) + patience;
        let (given_up, kept): (Vec<_>, Vec<_>) = batch.0.into_iter().partition(|waiting| end(waiting) <= now);
        let newer = std::mem::replace(&mut self.waiting, kept);
        for waiting in newer {
            self.join(waiting.entry);
        }
        if failure == Failure::Lasting {
            self.wait = self.persistence.longest();
        }
        // The last try of an entry is at the end of its patience, not some time before.
        let last = self.waiting.iter().filter(|waiting| waiting.first_try.is_some()).map(end).min();
        let next = now + self.wait;
        self.not_before = Some(last.map_or(next, |last| next.min(last)));
        self.wait = (self.wait * 2).min(self.persistence.longest());
        given_up.into_iter().map(|waiting| waiting.entry).collect()
    }

    /// An older entry that goes with this one keeps its place; what is new has all of the patience before it.
    fn join(&mut self, entry: Entry) {
        match self.waiting.iter_mut().find(|waiting| waiting.entry.goes_with(&entry)) {
            Some(waiting) => {
                waiting.entry.renew(entry);
                waiting.first_try = None;
            }
            None => self.waiting.push(Waiting { entry, first_try: None }),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;
    use crate::session::mail::{Event, Notice};
    use crate::shared::domain::PublicAddress;

    fn entry(port: u16, event: Event) -> Entry {
        let server = PublicAddress::new("host", port, false);
        Entry { notice: Notice { server, event, load: None, error: None, at: SystemTime::UNIX_EPOCH }, held_back: 0 }
    }

    fn outbox(most: usize) -> Outbox {
        let (retry, patience) = (Duration::from_secs(10), Duration::from_hours(1));
        Outbox::new(Persistence { retry, patience, most })
    }

    /// The seconds of all tries until a mail is given up.
    fn tries(failure: Failure) -> Vec<u64> {
        let start = Instant::now();
        let mut outbox = outbox(9);
        outbox.put(vec![entry(1, Event::NotResponding)]);
        let mut tries = Vec::new();
        let mut now = start;
        while let Some(due) = outbox.due(now) {
            now = due;
            tries.push((now - start).as_secs());
            let batch = outbox.take(now).unwrap();
            outbox.failed(batch, failure, now);
        }
        tries
    }

    #[test]
    fn delays_grow_for_an_hour_then_the_mail_is_given_up() {
        assert_eq!(tries(Failure::Passing), [0, 10, 30, 70, 150, 310, 630, 1_230, 1_830, 2_430, 3_030, 3_600]);
    }

    #[test]
    fn what_will_hardly_pass_is_tried_seldom() {
        assert_eq!(tries(Failure::Lasting), [0, 600, 1_200, 1_800, 2_400, 3_000, 3_600]);
    }

    #[test]
    fn success_forgets_the_delays() {
        let now = Instant::now();
        let mut outbox = outbox(9);
        outbox.put(vec![entry(1, Event::NotResponding)]);
        let batch = outbox.take(now).unwrap();
        outbox.failed(batch, Failure::Lasting, now);
        let later = outbox.due(now).unwrap();
        assert!(outbox.take(now).is_none(), "tried before it was due");
        assert!(outbox.take(later).is_some());
        outbox.succeeded();
        assert_eq!(outbox.due(later), None);
        outbox.put(vec![entry(1, Event::WorkingAgain)]);
        assert_eq!(outbox.due(later), Some(later));
    }

    #[test]
    fn what_comes_meanwhile_joins_the_next_try() {
        let now = Instant::now();
        let mut outbox = outbox(9);
        outbox.put(vec![entry(1, Event::NotResponding), entry(2, Event::NotResponding)]);
        let batch = outbox.take(now).unwrap();
        outbox.put(vec![entry(3, Event::MaximumLoad), entry(1, Event::WorkingAgain)]);
        outbox.failed(batch, Failure::Passing, now);
        let later = outbox.due(now).unwrap();
        let entries: Vec<_> =
            outbox.take(later).unwrap().entries().map(|entry| (entry.notice.event, entry.held_back)).collect();
        assert_eq!(entries, [(Event::NotResponding, 0), (Event::WorkingAgain, 1), (Event::MaximumLoad, 0)]);
    }

    #[test]
    fn the_oldest_make_room() {
        let mut outbox = outbox(2);
        assert_eq!(outbox.put((1..=5).map(|port| entry(port, Event::NotResponding)).collect()), 3);
        let batch = outbox.take(Instant::now()).unwrap();
        let servers: Vec<_> = batch.entries().map(|entry| entry.notice.server.to_string()).collect();
        assert_eq!(servers, ["host:4", "host:5"]);
    }
}
