//! Notices that wait to be mailed: collected, held back while a server flaps, and retried after a failure. Pure; the
//! caller passes the time.
//!
//! A simulation server has two topics: whether it responds, and whether it has room. For each topic only the newest
//! notice waits; it counts those that it has replaced.
//!
//! 1. The first notice waits for `gather`, so that servers that fail together are reported in one e-mail.
//! 2. For `flapping` after an e-mail about a topic, its notices are held back.
//! 3. After a failure all entries are retried, with a delay that doubles. An entry is given up after `mailPatience`.

use std::collections::BTreeMap;
use std::time::{Duration, Instant, SystemTime};

use crate::session::config::Timing;
use crate::shared::domain::Load;

/// A change of a simulation server that is mailed to the administrator.
#[derive(Debug, Clone, PartialEq)]
pub struct Notice {
    /// The simulation server's address, or the name that resolves to some.
    pub server: String,
    /// What happened.
    pub event: NoticeKind,
    /// Its load, if known.
    pub load: Option<Load>,
    /// The last error, if any; untrusted text.
    pub error: Option<String>,
    /// When it happened.
    pub at: SystemTime,
}

/// What happened to a simulation server, or to a name that resolves to some.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum NoticeKind {
    /// Its probes or lookups fail.
    NotResponding,
    /// They succeed again.
    WorkingAgain,
    /// Its load reached the threshold.
    MaximumLoad,
    /// Its load is below the threshold again.
    AvailableAgain,
}

impl NoticeKind {
    /// The event as text that follows 'simulation server'.
    pub fn words(self) -> &'static str {
        match self {
            Self::NotResponding => "not responding",
            Self::WorkingAgain => "working again",
            Self::MaximumLoad => "reached maximum load",
            Self::AvailableAgain => "available again",
        }
    }

    /// Its topic: whether a server has room for clients, or else whether it responds, or lookups of a name succeed.
    pub fn is_about_load(self) -> bool {
        matches!(self, Self::MaximumLoad | Self::AvailableAgain)
    }
}

/// One entry of an e-mail: the newest notice about a topic of a server, and how many it replaces.
#[derive(Debug, Clone)]
pub struct MailEntry {
    /// The newest notice, with the last error that is known.
    pub notice: Notice,
    /// Number of earlier notices that it has replaced.
    pub held_back: usize,
    /// When the first of them came.
    since: Instant,
    /// When sending the newest was first tried.
    first_try: Option<Instant>,
}

/// The notices that wait, and when the next e-mail is due.
#[derive(Debug, Clone)]
pub struct Outbox {
    timing: Timing,
    /// By [`NoticeKind::is_about_load`], then by server.
    topics: BTreeMap<(bool, String), TopicState>,
    /// The delay after the next failure.
    delay: Duration,
    /// After a failure: nothing is sent before this time.
    retry_at: Option<Instant>,
}

/// What the outbox knows of one topic of one server.
#[derive(Debug, Clone, Default)]
struct TopicState {
    waiting: Option<MailEntry>,
    /// Until when its notices are held back, after an e-mail about it.
    held_until: Option<Instant>,
}

impl Outbox {
    /// An empty outbox.
    pub fn new(timing: &Timing) -> Self {
        Self { timing: timing.clone(), topics: BTreeMap::new(), delay: timing.mail_retry, retry_at: None }
    }

    fn topic(&mut self, notice: &Notice) -> &mut TopicState {
        self.topics.entry((notice.event.is_about_load(), notice.server.clone())).or_default()
    }

    /// Adds a notice.
    pub fn add(&mut self, notice: Notice, now: Instant) {
        let topic = self.topic(&notice);
        let older = topic.waiting.take();
        let entry = MailEntry { notice, held_back: 0, since: now, first_try: None };
        topic.waiting = Some(match older {
            Some(older) => entry.replacing(older),
            None => entry,
        });
    }

    /// When the next e-mail is due, unless another notice is added.
    pub fn due(&self) -> Option<Instant> {
        let due = self.topics.values().filter_map(|topic| {
            let gathered = topic.waiting.as_ref()?.since + self.timing.gather;
            Some(topic.held_until.map_or(gathered, |end| end.max(gathered)))
        });
        due.min().map(|due| self.retry_at.map_or(due, |at| due.max(at)))
    }

    /// Removes and returns what is due for mail now, sorted by topic, then by server. The caller must report the
    /// outcome by [`Self::succeeded`] or [`Self::failed`].
    pub fn take(&mut self, now: Instant) -> Vec<MailEntry> {
        self.topics.retain(|_, topic| topic.waiting.is_some() || topic.held_until > Some(now));
        if self.due().is_none_or(|due| due > now) {
            return Vec::new();
        }
        // An e-mail that is sent anyway includes the entries that wait only for `gather`.
        let ready = self.topics.values_mut().filter(|topic| topic.held_until <= Some(now));
        let mut batch: Vec<MailEntry> = ready.filter_map(|topic| topic.waiting.take()).collect();
        for entry in &mut batch {
            entry.first_try.get_or_insert(now);
        }
        batch
    }

    /// Records that a batch was sent.
    pub fn succeeded(&mut self, batch: &[MailEntry], now: Instant) {
        (self.delay, self.retry_at) = (self.timing.mail_retry, None);
        for MailEntry { notice, .. } in batch {
            self.topic(notice).held_until = Some(now + self.timing.flapping);
        }
    }

    /// Records that a batch was not sent. Returns the entries that are given up; the others wait for the next try.
    pub fn failed(&mut self, batch: Vec<MailEntry>, now: Instant) -> Vec<MailEntry> {
        let patience = self.timing.mail_patience;
        let (given_up, kept): (Vec<_>, Vec<_>) =
            batch.into_iter().partition(|entry| entry.first_try.is_some_and(|first| first + patience <= now));
        for entry in kept {
            let topic = self.topic(&entry.notice);
            topic.waiting = Some(match topic.waiting.take() {
                Some(newer) => newer.replacing(entry),
                None => entry,
            });
        }
        self.retry_at = Some(now + self.delay);
        self.delay = (self.delay * 2).min(self.timing.mail_retry.max(patience / 6));
        given_up
    }
}

impl MailEntry {
    /// This entry in place of an older one about the same topic.
    fn replacing(mut self, older: Self) -> Self {
        self.held_back += older.held_back + 1;
        self.since = older.since;
        self.notice.error = self.notice.error.or(older.notice.error);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use NoticeKind::{AvailableAgain, MaximumLoad, NotResponding, WorkingAgain};

    /// When (in seconds), and what (port, event, held back).
    type Mail = (u64, Vec<(u16, NoticeKind, usize)>);

    fn notice(port: u16, event: NoticeKind) -> Notice {
        Notice { server: format!("host:{port}"), event, load: None, error: None, at: SystemTime::UNIX_EPOCH }
    }

    /// With the defaults: `gather` 10 s, `flapping` 600 s, `mailPatience` one hour.
    fn outbox() -> Outbox {
        Outbox::new(&Timing::default())
    }

    /// Plays notices (second, port, event).
    fn play(notices: &[(u64, u16, NoticeKind)]) -> Vec<Mail> {
        let start = Instant::now();
        let mut state = outbox();
        let mut mails = Vec::new();
        for second in 0..5_000 {
            let now = start + Duration::from_secs(second);
            for (_, port, event) in notices.iter().filter(|(when, ..)| *when == second) {
                state.add(notice(*port, *event), now);
            }
            let batch = state.take(now);
            state.succeeded(&batch, now);
            let mut mail: Vec<_> = batch
                .into_iter()
                .map(|entry| {
                    let server = entry.notice.server;
                    (server.rsplit_once(':').unwrap().1.parse().unwrap(), entry.notice.event, entry.held_back)
                })
                .collect();
            mail.sort_unstable();
            if !mail.is_empty() {
                mails.push((second, mail));
            }
        }
        assert!(state.topics.is_empty(), "something is kept for good: {state:?}");
        mails
    }

    #[test]
    fn what_belongs_together_is_one_mail_and_a_server_has_one_in_ten_minutes() {
        let one = |second, event, held_back| (second, vec![(1, event, held_back)]);
        for (notices, mails) in [
            // Servers that fail together.
            (
                vec![(0, 1, NotResponding), (3, 2, NotResponding), (9, 3, MaximumLoad), (11, 4, NotResponding)],
                vec![
                    (10, vec![(1, NotResponding, 0), (2, NotResponding, 0), (3, MaximumLoad, 0)]),
                    (21, vec![(4, NotResponding, 0)]),
                ],
            ),
            // The end of a failure is told once the time of flapping is over.
            (
                vec![(0, 1, NotResponding), (100, 1, WorkingAgain)],
                vec![one(10, NotResponding, 0), one(610, WorkingAgain, 0)],
            ),
            (
                vec![(0, 1, MaximumLoad), (590, 1, AvailableAgain)],
                vec![one(10, MaximumLoad, 0), one(610, AvailableAgain, 0)],
            ),
            // A second failure soon after the first waits.
            (
                vec![(0, 1, NotResponding), (100, 1, WorkingAgain), (200, 1, NotResponding)],
                vec![one(10, NotResponding, 0), one(610, NotResponding, 1)],
            ),
            // A failure is told though the same server was at maximum load before.
            (
                vec![(0, 1, MaximumLoad), (60, 1, NotResponding)],
                vec![one(10, MaximumLoad, 0), one(70, NotResponding, 0)],
            ),
            // One that flaps does not hold up the others.
            (
                vec![(0, 1, NotResponding), (20, 1, WorkingAgain), (21, 1, NotResponding), (30, 2, NotResponding)],
                vec![one(10, NotResponding, 0), (40, vec![(2, NotResponding, 0)]), one(610, NotResponding, 1)],
            ),
        ] {
            assert_eq!(play(&notices), mails, "{notices:?}");
        }
    }

    /// Has one server meet these events, one after the other, from a second on; returns when the mails come, and how many
    /// notices each has held back.
    fn flap(begin: u64, step: u64, events: &[NoticeKind], until: u64) -> Vec<(u64, usize)> {
        let seconds = (begin..until).step_by(usize::try_from(step).unwrap());
        let notices: Vec<_> = seconds.zip(events.iter().cycle()).map(|(second, event)| (second, 1, *event)).collect();
        play(&notices).into_iter().map(|(when, mail)| (when, mail[0].2)).collect()
    }

    #[test]
    fn a_flapping_server_is_one_mail_in_ten_minutes_with_a_count() {
        let flapping = [NotResponding, WorkingAgain];
        assert_eq!(flap(0, 1, &flapping, 1_000), [(10, 10), (610, 599), (1_210, 388)]);
        assert_eq!(flap(0, 30, &flapping, 600), [(10, 0), (610, 18)]);
        let full_too = [MaximumLoad, NotResponding, WorkingAgain, AvailableAgain];
        let mails: Vec<u64> = flap(0, 1, &full_too, 1_200).into_iter().map(|(when, _)| when).collect();
        assert_eq!(mails, [10, 610, 1_210]);
    }

    #[test]
    fn delays_grow_for_an_hour_then_the_mail_is_given_up() {
        let mut outbox = outbox();
        outbox.add(notice(1, NotResponding), Instant::now());
        let first = outbox.due().unwrap();
        let mut tries = Vec::new();
        while let Some(due) = outbox.due() {
            tries.push((due - first).as_secs());
            let batch = outbox.take(due);
            let last = outbox.failed(batch, due);
            assert_eq!(last.len(), usize::from(outbox.due().is_none()));
        }
        assert_eq!(tries, [0, 10, 30, 70, 150, 310, 630, 1_230, 1_830, 2_430, 3_030, 3_630]);
    }

    #[test]
    fn success_resets_the_delays() {
        let mut outbox = outbox();
        outbox.add(notice(1, NotResponding), Instant::now());
        let due = outbox.due().unwrap();
        let batch = outbox.take(due);
        outbox.failed(batch, due);
        let later = outbox.due().unwrap();
        assert!(outbox.take(due).is_empty(), "tried before it was due");
        let batch = outbox.take(later);
        outbox.succeeded(&batch, later);
        assert_eq!(outbox.due(), None);
        outbox.add(notice(2, WorkingAgain), later);
        assert_eq!(outbox.due(), Some(later + Duration::from_secs(10)));
    }

    #[test]
    fn what_comes_while_an_e_mail_is_sent_joins_the_next_try() {
        let mut outbox = outbox();
        let start = Instant::now();
        outbox.add(notice(1, NotResponding), start);
        outbox.add(notice(2, NotResponding), start);
        let due = outbox.due().unwrap();
        let batch = outbox.take(due);
        outbox.add(notice(3, MaximumLoad), due);
        outbox.add(notice(1, WorkingAgain), due);
        outbox.failed(batch, due);
        let later = outbox.due().unwrap();
        let entries: Vec<_> =
            outbox.take(later).into_iter().map(|entry| (entry.notice.event, entry.held_back)).collect();
        assert_eq!(entries, [(WorkingAgain, 1), (NotResponding, 0), (MaximumLoad, 0)]);
    }
}
