//! Entries that wait to be mailed: when a failed e-mail is sent again, and when it is given up. Pure; time is passed in.
//!
//! All entries that wait go into the next e-mail. A newer entry of the same server and topic replaces the older one.

use std::time::{Duration, Instant};

use super::notices::Entry;

/// When a failed e-mail is sent again, and when it is given up.
#[derive(Debug, Clone, Copy)]
pub struct RetryPolicy {
    /// The delay after the first failure; it doubles with each.
    pub first_delay: Duration,
    /// How long an entry is tried before it is given up.
    pub give_up_after: Duration,
    /// How many entries may wait; the oldest are dropped for newer ones.
    pub max_waiting: usize,
}

impl RetryPolicy {
    /// The longest delay between two tries.
    fn longest_delay(self) -> Duration {
        self.first_delay.max(self.give_up_after / 6)
    }
}

/// The entries that wait to be mailed.
#[derive(Debug)]
pub struct Outbox {
    policy: RetryPolicy,
    waiting: Vec<Waiting>,
    /// The delay after the next failure.
    delay: Duration,
    not_before: Option<Instant>,
}

/// An entry that waits.
#[derive(Debug, Clone)]
struct Waiting {
    entry: Entry,
    first_try: Option<Instant>,
}

/// The entries of one e-mail.
#[derive(Debug, Clone)]
pub struct Batch(Vec<Waiting>);

impl Batch {
    /// The entries in the order of the e-mail: by event, then by server.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> {
        let mut entries: Vec<&Entry> = self.0.iter().map(|waiting| &waiting.entry).collect();
        entries.sort_by_key(|entry| (entry.notice.event, entry.notice.server.clone()));
        entries.into_iter()
    }
}

/// Whether another try can succeed (RFC 5321, section 4.2.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// It may, as after a refused connection.
    Transient,
    /// Not before somebody changes something, such as a wrong password. It is tried again too, since only an e-mail can
    /// tell the administrator, and such things are often corrected within the hour; but with the longest delay from the
    /// start, so that no account is locked for too many wrong logins.
    Permanent,
}

impl Outbox {
    /// An empty outbox.
    #[must_use]
    pub fn new(policy: RetryPolicy) -> Self {
        Self { policy, waiting: Vec::new(), delay: policy.first_delay, not_before: None }
    }

    /// Adds entries. Returns how many of the oldest were dropped.
    pub fn put(&mut self, entries: Vec<Entry>) -> usize {
        for entry in entries {
            self.join(entry);
        }
        let surplus = self.waiting.len().saturating_sub(self.policy.max_waiting);
        self.waiting.drain(..surplus).count()
    }

    /// When the next try is due; nothing if no entry waits.
    #[must_use]
    pub fn due(&self, now: Instant) -> Option<Instant> {
        (!self.waiting.is_empty()).then(|| self.not_before.unwrap_or(now))
    }

    /// Takes out what is to be mailed now. How it went is to be reported by [`Self::succeeded`] or [`Self::failed`].
    pub fn take(&mut self, now: Instant) -> Option<Batch> {
        self.due(now).filter(|due| *due <= now)?;
        let mut batch = std::mem::take(&mut self.waiting);
        for waiting in &mut batch {
            waiting.first_try.get_or_insert(now);
        }
        Some(Batch(batch))
    }

    /// The last batch was sent.
    pub fn succeeded(&mut self) {
        self.delay = self.policy.first_delay;
        self.not_before = None;
    }

    /// A batch was not sent. Returns the entries that are given up.
    pub fn failed(&mut self, batch: Batch, failure: Failure, now: Instant) -> Vec<Entry> {
        let give_up_after = self.policy.give_up_after;
        let end = |waiting: &Waiting| waiting.first_try.unwrap_or(now) + give_up_after;
        let (given_up, kept): (Vec<_>, Vec<_>) = batch.0.into_iter().partition(|waiting| end(waiting) <= now);
        let newer = std::mem::replace(&mut self.waiting, kept);
        for waiting in newer {
            self.join(waiting.entry);
        }
        if failure == Failure::Permanent {
            self.delay = self.policy.longest_delay();
        }
        // The last try of an entry is at the end of its time, not some time before.
        let last = self.waiting.iter().filter(|waiting| waiting.first_try.is_some()).map(end).min();
        let next = now + self.delay;
        self.not_before = Some(last.map_or(next, |last| next.min(last)));
        self.delay = (self.delay * 2).min(self.policy.longest_delay());
        given_up.into_iter().map(|waiting| waiting.entry).collect()
    }

    /// Adds an entry. It replaces an older one about the same, at its place, and may be tried for the whole time again.
    fn join(&mut self, entry: Entry) {
        match self.waiting.iter_mut().find(|waiting| waiting.entry.is_about_the_same(&entry)) {
            Some(waiting) => {
                waiting.entry.replace(entry);
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

    fn entry(port: u16, event: Event) -> Entry {
        let server = format!("host:{port}");
        Entry { notice: Notice { server, event, load: None, error: None, at: SystemTime::UNIX_EPOCH }, held_back: 0 }
    }

    fn outbox(max_waiting: usize) -> Outbox {
        let (first_delay, give_up_after) = (Duration::from_secs(10), Duration::from_hours(1));
        Outbox::new(RetryPolicy { first_delay, give_up_after, max_waiting })
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
        assert_eq!(tries(Failure::Transient), [0, 10, 30, 70, 150, 310, 630, 1_230, 1_830, 2_430, 3_030, 3_600]);
    }

    #[test]
    fn what_will_hardly_pass_is_tried_seldom() {
        assert_eq!(tries(Failure::Permanent), [0, 600, 1_200, 1_800, 2_400, 3_000, 3_600]);
    }

    #[test]
    fn success_forgets_the_delays() {
        let now = Instant::now();
        let mut outbox = outbox(9);
        outbox.put(vec![entry(1, Event::NotResponding)]);
        let batch = outbox.take(now).unwrap();
        outbox.failed(batch, Failure::Permanent, now);
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
        outbox.failed(batch, Failure::Transient, now);
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
        let servers: Vec<_> = batch.entries().map(|entry| entry.notice.server.clone()).collect();
        assert_eq!(servers, ["host:4", "host:5"]);
    }
}
