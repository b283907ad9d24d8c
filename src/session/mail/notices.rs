//! Which notices are mailed when: gathering, and the limit for flapping servers. Pure; time is passed in.
//!
//! There are two topics about a simulation server: whether it responds, and whether it has room.
//!
//! 1. The first notice waits for `gather`, so that servers that fail together are reported in one e-mail.
//! 2. For `flapping` after an e-mail about a server, its notices are held back and counted. After that time the next
//!    e-mail has one entry for each topic, with the newest notice and the count.
//! 3. One notice is not held back: that a server does not respond, if the last e-mail was only about its load.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant, SystemTime};

use actix::Message;

use crate::shared::domain::Load;

/// A change of a simulation server that the administrator should know of.
#[derive(Message, Debug, Clone, PartialEq)]
#[rtype(result = "()")]
pub struct Notice {
    /// The simulation server's address, or the name that leads to some.
    pub server: String,
    /// What happened.
    pub event: Event,
    /// Its load, if known.
    pub load: Option<Load>,
    /// The last error, if any. It may hold any text.
    pub error: Option<String>,
    /// When it happened.
    pub at: SystemTime,
}

/// What happened to a simulation server or to a name, in the order of the lines in an e-mail.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Event {
    /// It gives no usable answer.
    NotResponding,
    /// It gives good answers again.
    WorkingAgain,
    /// Its load reached the threshold.
    MaximumLoad,
    /// Its load is below the threshold again.
    AvailableAgain,
    /// A name can't be looked up.
    LookupFails,
    /// It can be again.
    LookupWorks,
}

/// What an event is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Topic {
    /// Whether a server responds, or a name.
    Health,
    /// Whether a server has room for clients.
    Capacity,
}

impl Event {
    /// What it happens to, one and many.
    #[must_use]
    pub fn nouns(self) -> [&'static str; 2] {
        match self {
            Self::LookupFails | Self::LookupWorks => ["lookup of simulation servers", "lookups of simulation servers"],
            _ => ["simulation server", "simulation servers"],
        }
    }

    /// The event in words that follow those of [`Event::nouns`].
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::LookupFails => "failing",
            Self::NotResponding => "not responding",
            Self::WorkingAgain | Self::LookupWorks => "working again",
            Self::MaximumLoad => "reached maximum load",
            Self::AvailableAgain => "available again",
        }
    }

    /// The topic of the event.
    #[must_use]
    pub fn topic(self) -> Topic {
        match self {
            Self::NotResponding | Self::WorkingAgain | Self::LookupFails | Self::LookupWorks => Topic::Health,
            Self::MaximumLoad | Self::AvailableAgain => Topic::Capacity,
        }
    }
}

/// One entry of an e-mail: the newest notice about a server and topic, and how many it stands for.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// The newest notice, with the last error that is known.
    pub notice: Notice,
    /// How many earlier notices were held back.
    pub held_back: usize,
}

impl Entry {
    /// Whether both are about the same topic of the same server.
    #[must_use]
    pub fn is_about_the_same(&self, other: &Self) -> bool {
        self.notice.event.topic() == other.notice.event.topic() && self.notice.server == other.notice.server
    }

    /// Replaces this entry with a newer one about the same, and counts it as held back.
    pub fn replace(&mut self, newer: Self) {
        let error = self.notice.error.take();
        self.notice = newer.notice;
        self.notice.error = self.notice.error.take().or(error);
        self.held_back += newer.held_back + 1;
    }
}

/// The notices since the last e-mail, and when each server was mailed about.
#[derive(Debug)]
pub struct Notices {
    gather: Duration,
    flapping: Duration,
    servers: HashMap<String, State>,
}

#[derive(Debug, Default)]
struct State {
    /// The entry of each topic that waits, and when it began to.
    pending: BTreeMap<Topic, (Entry, Instant)>,
    cooldown: Option<Cooldown>,
}

/// The time after an e-mail about a server in which its notices are held back.
#[derive(Debug, Clone, Copy)]
struct Cooldown {
    end: Instant,
    /// Whether that e-mail had an entry about the server's health.
    about_health: bool,
}

impl Notices {
    /// No notices yet.
    #[must_use]
    pub fn new(gather: Duration, flapping: Duration) -> Self {
        Self { gather, flapping, servers: HashMap::new() }
    }

    /// Adds a notice.
    pub fn add(&mut self, notice: Notice, now: Instant) {
        let state = self.servers.entry(notice.server.clone()).or_default();
        state.cooldown.take_if(|cooldown| cooldown.end <= now);
        let topic = notice.event.topic();
        let entry = Entry { notice, held_back: 0 };
        match state.pending.get_mut(&topic) {
            Some((pending, _)) => pending.replace(entry),
            None => drop(state.pending.insert(topic, (entry, now))),
        }
    }

    /// When the next e-mail is due, if no other notice comes.
    #[must_use]
    pub fn due(&self) -> Option<Instant> {
        self.servers.values().filter_map(|state| state.due(self.gather)).min()
    }

    /// Returns what is to be mailed now, and counts it as mailed.
    pub fn take(&mut self, now: Instant) -> Vec<Entry> {
        self.servers
            .retain(|_, state| !state.pending.is_empty() || state.cooldown.is_some_and(|cooldown| cooldown.end > now));
        if self.due().is_none_or(|due| due > now) {
            return Vec::new();
        }
        let mut mailed = Vec::new();
        for state in self.servers.values_mut() {
            // An e-mail that is sent anyway includes what would else wait for `gather` only.
            if !state.pending.is_empty() && state.held_until().is_none_or(|end| end <= now) {
                let about_health = state.pending.contains_key(&Topic::Health);
                state.cooldown = Some(Cooldown { end: now + self.flapping, about_health });
                mailed.extend(std::mem::take(&mut state.pending).into_values().map(|(entry, _)| entry));
            }
        }
        mailed
    }
}

impl State {
    /// Until when the pending entries are held back, if they are.
    fn held_until(&self) -> Option<Instant> {
        let cooldown = self.cooldown?;
        let fails =
            |(entry, _): &(Entry, Instant)| matches!(entry.notice.event, Event::NotResponding | Event::LookupFails);
        let fails_now = !cooldown.about_health && self.pending.get(&Topic::Health).is_some_and(fails);
        (!fails_now).then_some(cooldown.end)
    }

    /// When the pending entries may be mailed.
    fn due(&self, gather: Duration) -> Option<Instant> {
        let first = self.pending.values().map(|(_, first)| *first).min()?;
        Some(self.held_until().unwrap_or(first + gather))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use Event::{AvailableAgain, MaximumLoad, NotResponding, WorkingAgain};

    /// When (second), and what (port, event, held back).
    type Mail = (u64, Vec<(u16, Event, usize)>);

    /// Plays notices (second, port, event) with a gathering of 10 s and a flapping limit of 600 s.
    fn play(notices: &[(u64, u16, Event)]) -> Vec<Mail> {
        let start = Instant::now();
        let mut state = Notices::new(Duration::from_secs(10), Duration::from_mins(10));
        let mut mails = Vec::new();
        for second in 0..5_000 {
            let now = start + Duration::from_secs(second);
            for (_, port, event) in notices.iter().filter(|(when, ..)| *when == second) {
                let server = format!("host:{port}");
                let notice = Notice { server, event: *event, load: None, error: None, at: SystemTime::UNIX_EPOCH };
                state.add(notice, now);
            }
            let mut mail: Vec<_> = state
                .take(now)
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
        assert!(state.servers.is_empty(), "something is kept for good: {state:?}");
        mails
    }

    #[test]
    fn servers_that_fail_together_are_one_mail() {
        let notices = [(0, 1, NotResponding), (3, 2, NotResponding), (9, 3, MaximumLoad), (11, 4, NotResponding)];
        let first = vec![(1, NotResponding, 0), (2, NotResponding, 0), (3, MaximumLoad, 0)];
        assert_eq!(play(&notices), [(10, first), (21, vec![(4, NotResponding, 0)])]);
    }

    #[test]
    fn the_end_of_a_failure_is_told_once_the_time_of_flapping_is_over() {
        let mails = play(&[(0, 1, NotResponding), (100, 1, WorkingAgain)]);
        assert_eq!(mails, [(10, vec![(1, NotResponding, 0)]), (610, vec![(1, WorkingAgain, 0)])]);
        let mails = play(&[(0, 1, MaximumLoad), (590, 1, AvailableAgain)]);
        assert_eq!(mails, [(10, vec![(1, MaximumLoad, 0)]), (610, vec![(1, AvailableAgain, 0)])]);
    }

    #[test]
    fn a_flapping_server_is_one_mail_in_ten_minutes_with_a_count() {
        let turns = |step: u64, until: u64| -> Vec<_> {
            (0..until / step)
                .map(|turn| (turn * step, 1, if turn % 2 == 0 { NotResponding } else { WorkingAgain }))
                .collect()
        };
        let entry = |event, held_back| vec![(1, event, held_back)];
        let each_second = play(&turns(1, 1_000));
        assert_eq!(each_second.iter().map(|(when, _)| *when).collect::<Vec<_>>(), [10, 610, 1_210]);
        assert_eq!(each_second[0].1, entry(NotResponding, 10));
        assert_eq!(each_second[1].1, entry(NotResponding, 599));
        assert_eq!(each_second[2].1, entry(WorkingAgain, 388));
        let each_half_minute = play(&turns(30, 600));
        assert_eq!(each_half_minute, [(10, entry(NotResponding, 0)), (610, entry(WorkingAgain, 18))]);
    }

    #[test]
    fn a_second_failure_soon_after_the_first_waits() {
        let notices = [(0, 1, NotResponding), (100, 1, WorkingAgain), (200, 1, NotResponding)];
        assert_eq!(play(&notices), [(10, vec![(1, NotResponding, 0)]), (610, vec![(1, NotResponding, 1)])]);
    }

    #[test]
    fn a_failure_is_told_though_the_same_server_was_at_maximum_load_before() {
        let mails = play(&[(0, 1, MaximumLoad), (60, 1, NotResponding)]);
        assert_eq!(mails, [(10, vec![(1, MaximumLoad, 0)]), (70, vec![(1, NotResponding, 0)])]);
    }

    #[test]
    fn a_server_that_is_full_and_fails_again_and_again_is_one_mail_in_ten_minutes_after_the_first_two() {
        let notices: Vec<_> = (0..300)
            .flat_map(|turn| {
                [
                    (turn * 4, MaximumLoad),
                    (turn * 4 + 1, NotResponding),
                    (turn * 4 + 2, WorkingAgain),
                    (turn * 4 + 3, AvailableAgain),
                ]
            })
            .map(|(second, event)| (second, 1, event))
            .collect();
        let mails: Vec<u64> = play(&notices).into_iter().map(|(when, _)| when).collect();
        assert_eq!(mails, [10, 610, 1_210]);
        let full_then_flapping: Vec<_> = std::iter::once((0, 1, MaximumLoad))
            .chain((20..500).map(|second| (second, 1, if second % 2 == 0 { NotResponding } else { WorkingAgain })))
            .collect();
        let mails: Vec<u64> = play(&full_then_flapping).into_iter().map(|(when, _)| when).collect();
        assert_eq!(mails, [10, 30, 630]);
    }

    #[test]
    fn one_flapping_server_does_not_hold_up_the_others() {
        let notices = [(0, 1, NotResponding), (20, 1, WorkingAgain), (21, 1, NotResponding), (30, 2, NotResponding)];
        let expected =
            [(10, vec![(1, NotResponding, 0)]), (40, vec![(2, NotResponding, 0)]), (610, vec![(1, NotResponding, 1)])];
        assert_eq!(play(&notices), expected);
    }

    #[test]
    fn the_last_error_outlives_the_recovery() {
        let notice = |event, error: Option<&str>| Entry {
            notice: Notice {
                server: "host:1".to_owned(),
                event,
                load: None,
                error: error.map(str::to_owned),
                at: SystemTime::UNIX_EPOCH,
            },
            held_back: 0,
        };
        let mut entry = notice(NotResponding, Some("connection refused"));
        entry.replace(notice(WorkingAgain, None));
        assert_eq!(entry.notice.error.as_deref(), Some("connection refused"));
        assert_eq!((entry.notice.event, entry.held_back), (WorkingAgain, 1));
    }
}
