//! Notices that wait to be mailed: collected, held back while a server flaps, and retried after a failure. Pure; the
//! caller passes the time.
//!
//! A simulation server has two topics: whether it responds, and whether it has room. For each topic only the newest
//! notice waits.
//!
//! 1. The first notice waits for `gather`, so that servers that fail together are reported in one e-mail.
//! 2. For `flapping` after an e-mail about a topic, its notices are held back.
//! 3. After a failure all are retried, with a delay that doubles. A notice is given up after `mailPatience`.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::session::config::Timing;
use crate::shared::domain::{Failure, Load};

/// A change of a simulation server that is mailed to the administrator.
#[derive(Debug, Clone, PartialEq)]
pub struct Notice {
    /// The simulation server's address.
    pub server: String,
    /// What happened.
    pub event: NoticeKind,
    /// Its load, if known.
    pub load: Option<Load>,
    /// The number of its clients and of its places, if known.
    pub places: Option<(u32, u32)>,
    /// The failed probe that begins or ends with it, if any.
    pub failure: Option<Failure>,
    /// When it happened, as text.
    pub at: String,
}

/// What happened to a simulation server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum NoticeKind {
    /// Its probes fail.
    NotResponding,
    /// They succeed again.
    WorkingAgain,
    /// Its load has reached the threshold, or all its places are taken.
    MaximumLoad,
    /// It takes clients again.
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

    /// Its topic: whether a server has room for clients, or else whether it responds.
    pub fn is_about_load(self) -> bool {
        matches!(self, Self::MaximumLoad | Self::AvailableAgain)
    }
}

/// The newest notice about a topic of a server.
#[derive(Debug, Clone)]
pub struct WaitingNotice {
    /// What has happened.
    pub notice: Notice,
    /// When its time to wait for others, `gather`, ends.
    gathered: Instant,
    /// When it is given up if it can't be sent.
    expires: Instant,
}

/// The notices that wait, and when the next e-mail is due.
#[derive(Debug)]
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
#[derive(Debug, Default)]
struct TopicState {
    waiting: Option<WaitingNotice>,
    /// The end of the time in which its notices are held back, after an e-mail about it.
    held_until: Option<Instant>,
}

impl Outbox {
    /// An empty outbox.
    pub fn new(timing: &Timing) -> Self {
        Self {
            timing: timing.clone(),
            topics: BTreeMap::new(),
            delay: timing.mail_retry,
            retry_at: None,
        }
    }

    fn topic(&mut self, notice: &Notice) -> &mut TopicState {
        self.topics
            .entry((notice.event.is_about_load(), notice.server.clone()))
            .or_default()
    }

    /// Adds a notice. It replaces one about the same topic.
    pub fn add(&mut self, notice: Notice, now: Instant) {
        let gather_until = now + self.timing.gather;
        let expires = now + self.timing.mail_patience;
        let topic = self.topic(&notice);
        let gathered = topic.waiting.as_ref().map_or(gather_until, |older| older.gathered);
        topic.waiting = Some(WaitingNotice {
            notice,
            gathered,
            expires,
        });
    }

    /// When the next e-mail is due, unless another notice is added.
    pub fn due(&self) -> Option<Instant> {
        let due = |topic: &TopicState| Some(topic.waiting.as_ref()?.gathered).max(topic.held_until);
        let first = self.topics.values().filter_map(due).min()?;
        Some(first).max(self.retry_at)
    }

    /// Removes and returns the notices that are due, sorted by topic, then by server. The caller must report the
    /// outcome by [`Self::succeeded`] or [`Self::failed`].
    pub fn take(&mut self, now: Instant) -> Vec<WaitingNotice> {
        self.topics
            .retain(|_, topic| topic.waiting.is_some() || topic.held_until > Some(now));
        if self.due().is_none_or(|due| due > now) {
            return Vec::new();
        }
        // An e-mail that is sent anyway includes the notices that wait only for `gather`.
        let ready = self.topics.values_mut().filter(|topic| topic.held_until <= Some(now));
        ready.filter_map(|topic| topic.waiting.take()).collect()
    }

    /// Records that a batch was sent.
    pub fn succeeded(&mut self, batch: &[WaitingNotice], now: Instant) {
        self.delay = self.timing.mail_retry;
        self.retry_at = None;
        for WaitingNotice { notice, .. } in batch {
            self.topic(notice).held_until = Some(now + self.timing.flapping);
        }
    }

    /// Records that a batch was not sent. Returns the notices that are given up; the others wait for the next try.
    pub fn failed(&mut self, batch: Vec<WaitingNotice>, now: Instant) -> Vec<WaitingNotice> {
        let (given_up, kept): (Vec<_>, Vec<_>) = batch.into_iter().partition(|waiting| waiting.expires <= now);
        for waiting in kept {
            let topic = self.topic(&waiting.notice);
            topic.waiting = Some(waiting);
        }
        self.retry_at = Some(now + self.delay);
        self.delay = (self.delay * 2).min(self.timing.mail_retry.max(self.timing.mail_patience / 6));
        given_up
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use NoticeKind::{AvailableAgain, MaximumLoad, NotResponding, WorkingAgain};

    /// The second of a mail, and its notices (port, event).
    type Mail = (u64, Vec<(u16, NoticeKind)>);

    fn notice(port: u16, event: NoticeKind) -> Notice {
        Notice {
            server: format!("host:{port}"),
            event,
            load: None,
            places: None,
            failure: None,
            at: String::new(),
        }
    }

    /// An outbox with the defaults: `gather` 10 s, `flapping` 600 s, `mailPatience` one hour.
    fn outbox() -> Outbox {
        Outbox::new(&Timing::default())
    }

    /// Adds these notices (second, port, event) to an outbox; returns its mails.
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
            let entry = |WaitingNotice { notice, .. }| {
                (notice.server.rsplit_once(':').unwrap().1.parse().unwrap(), notice.event)
            };
            let mut mail: Vec<_> = batch.into_iter().map(entry).collect();
            mail.sort_unstable();
            if !mail.is_empty() {
                mails.push((second, mail));
            }
        }
        assert!(state.topics.is_empty(), "something is kept for good: {state:?}");
        mails
    }

    #[test]
    fn notices_are_gathered_into_one_mail() {
        let one = |second, event| (second, vec![(1, event)]);
        for (notices, mails) in [
            // Servers that fail together.
            (
                vec![
                    (0, 1, NotResponding),
                    (3, 2, NotResponding),
                    (9, 3, MaximumLoad),
                    (11, 4, NotResponding),
                ],
                vec![
                    (10, vec![(1, NotResponding), (2, NotResponding), (3, MaximumLoad)]),
                    (21, vec![(4, NotResponding)]),
                ],
            ),
            // A recovery is mailed `flapping` seconds after the failure.
            (
                vec![(0, 1, NotResponding), (100, 1, WorkingAgain)],
                vec![one(10, NotResponding), one(610, WorkingAgain)],
            ),
            (
                vec![(0, 1, MaximumLoad), (590, 1, AvailableAgain)],
                vec![one(10, MaximumLoad), one(610, AvailableAgain)],
            ),
            // A second failure soon after the first waits.
            (
                vec![(0, 1, NotResponding), (100, 1, WorkingAgain), (200, 1, NotResponding)],
                vec![one(10, NotResponding), one(610, NotResponding)],
            ),
            // A failure is mailed although the same server was at maximum load before.
            (
                vec![(0, 1, MaximumLoad), (60, 1, NotResponding)],
                vec![one(10, MaximumLoad), one(70, NotResponding)],
            ),
            // A server that flaps does not delay the others.
            (
                vec![
                    (0, 1, NotResponding),
                    (20, 1, WorkingAgain),
                    (21, 1, NotResponding),
                    (30, 2, NotResponding),
                ],
                vec![
                    one(10, NotResponding),
                    (40, vec![(2, NotResponding)]),
                    one(610, NotResponding),
                ],
            ),
        ] {
            assert_eq!(play(&notices), mails, "{notices:?}");
        }
    }

    #[test]
    fn a_server_that_flaps_each_second_is_one_mail_in_ten_minutes() {
        for events in [
            vec![NotResponding, WorkingAgain],
            vec![MaximumLoad, NotResponding, WorkingAgain, AvailableAgain],
        ] {
            let notices: Vec<_> = (0..1_000)
                .zip(events.iter().cycle())
                .map(|(second, event)| (second, 1, *event))
                .collect();
            let mails: Vec<u64> = play(&notices).into_iter().map(|(when, _)| when).collect();
            assert_eq!(mails, [10, 610, 1_210]);
        }
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
}
