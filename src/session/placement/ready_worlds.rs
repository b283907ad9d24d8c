//! What simulation servers keep ready: how much is left of it, and which server has to keep how much of a list.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::hash::Hash;
use std::time::{Duration, Instant};

use crate::shared::domain::{ProjectUrl, ReadyCount, ServerReport, View};

/// The simulations that servers keep ready, as they report, less the clients that were sent there since.
#[derive(Debug)]
pub struct ReadyWorlds<Id>(HashMap<ProjectUrl, HashMap<Id, Left>>);

#[derive(Debug, Default)]
struct Left {
    reported: u32,
    /// What the report before said.
    before: u32,
    /// When clients were sent that the report may not show.
    sent: Vec<Instant>,
}

/// Time after which a report shows a client that was sent to its server.
const UNSEEN: Duration = Duration::from_millis(500);

impl<Id> Default for ReadyWorlds<Id> {
    fn default() -> Self {
        Self(HashMap::new())
    }
}

impl<Id: Clone + Eq + Hash> ReadyWorlds<Id> {
    /// Records what a server has reported.
    pub fn report(&mut self, id: &Id, now: Instant, report: &ServerReport) {
        for left in self.0.values_mut().filter_map(|servers| servers.get_mut(id)) {
            left.before = std::mem::take(&mut left.reported);
        }
        for one in report
            .ready
            .iter()
            .filter(|one| one.ready > 0 && one.mode == View::default())
        {
            let servers = self.0.entry(one.world.clone()).or_default();
            let left = servers.entry(id.clone()).or_default();
            left.reported = left.reported.saturating_add(one.ready);
        }
        for left in self.0.values_mut().filter_map(|servers| servers.get_mut(id)) {
            // Those that are gone were taken by the first who were sent.
            let taken = left.before.saturating_sub(left.reported) as usize;
            left.sent.drain(..taken.min(left.sent.len()));
            left.sent.retain(|at| now.saturating_duration_since(*at) < UNSEEN);
        }
        self.forget(id, |left| left.reported == 0);
    }

    /// Forgets a server.
    pub fn lose(&mut self, id: &Id) {
        self.forget(id, |_| true);
    }

    /// Forgets the worlds of a server of which this holds.
    fn forget(&mut self, id: &Id, is_gone: impl Fn(&Left) -> bool) {
        self.0.retain(|_, servers| {
            if servers.get(id).is_some_and(&is_gone) {
                servers.remove(id);
            }
            !servers.is_empty()
        });
    }

    /// A client was sent to a server.
    pub fn place(&mut self, id: &Id, world: &ProjectUrl, now: Instant) {
        if let Some(left) = self.0.get_mut(world).and_then(|servers| servers.get_mut(id)) {
            left.sent.push(now);
        }
    }

    /// Whether some server has one of a world.
    pub fn has(&self, world: &ProjectUrl) -> bool {
        self.0.contains_key(world)
    }

    /// How many of a world a server has left.
    pub fn left(&self, id: &Id, world: &ProjectUrl) -> usize {
        let left = self.0.get(world).and_then(|servers| servers.get(id));
        left.map_or(0, |left| (left.reported as usize).saturating_sub(left.sent.len()))
    }
}

/// Shares out what is to be kept ready over servers, each with its number of slots: evenly, in proportion to the slots,
/// and the same again for the same servers. Returns the list of each server.
pub fn shares<Id>(
    wanted: &[ReadyCount],
    servers: &[(Id, u32)],
    accepts: impl Fn(&Id, &ProjectUrl) -> bool,
) -> Vec<Vec<ReadyCount>> {
    let mut taken = vec![0_u32; servers.len()];
    let mut lists: Vec<Vec<ReadyCount>> = servers.iter().map(|_| Vec::new()).collect();
    for one in wanted {
        let mut counts: Vec<Option<u32>> = servers
            .iter()
            .map(|(id, _)| accepts(id, &one.world).then_some(0))
            .collect();
        let candidates = servers.iter().zip(&taken).zip(&counts).enumerate();
        // The servers that accept it and have room, the one with the smallest part in use first.
        let mut with_room: BinaryHeap<Reverse<(u64, usize)>> = candidates
            .filter(|(_, (_, count))| count.is_some())
            .filter_map(|(index, (((_, slots), taken), _))| Some(Reverse((part(*taken, *slots)?, index))))
            .collect();
        for _ in 0..one.count {
            let Some(Reverse((_, index))) = with_room.pop() else {
                break;
            };
            let slots = servers.get(index).map_or(0, |(_, slots)| *slots);
            if let (Some(taken), Some(Some(count))) = (taken.get_mut(index), counts.get_mut(index)) {
                *taken += 1;
                *count += 1;
                with_room.extend(part(*taken, slots).map(|part| Reverse((part, index))));
            }
        }
        for (list, count) in lists.iter_mut().zip(counts) {
            list.extend(count.map(|count| ReadyCount { count, ..one.clone() }));
        }
    }
    lists
}

/// The part of a server's slots that is in use, as a number that sorts like it; `None` if all are.
fn part(taken: u32, slots: u32) -> Option<u64> {
    (taken < slots).then(|| (f64::from(taken) / f64::from(slots)).to_bits())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::{Load, ReadyStatus};

    fn world(name: &str) -> ProjectUrl {
        ProjectUrl::parse(&format!("https://github.com/lab/arm/blob/main/worlds/{name}.wbt")).unwrap()
    }

    fn count(name: &str, count: u32) -> ReadyCount {
        ReadyCount {
            world: world(name),
            mode: View::default(),
            count,
        }
    }

    #[test]
    fn a_list_is_shared_by_slots_among_servers_that_accept_it() {
        let share = |wanted: &[ReadyCount], servers: &[(u32, u32)]| {
            let lists = shares(wanted, servers, |id, world| *id != 9 || world.world() != "b.wbt");
            let numbers = |list: Vec<ReadyCount>| list.into_iter().map(|one| one.count).collect::<Vec<_>>();
            lists.into_iter().map(numbers).collect::<Vec<_>>()
        };
        assert_eq!(share(&[count("a", 30)], &[(0, 20), (1, 20)]), [[15], [15]]);
        assert_eq!(share(&[count("a", 30)], &[(0, 40), (1, 20)]), [[20], [10]]);
        assert_eq!(
            share(&[count("a", 30)], &[(0, 5), (1, 5)]),
            [[5], [5]],
            "no more than slots"
        );
        assert_eq!(share(&[count("a", 0)], &[(0, 5)]), [[0]], "listed for another time");
        assert_eq!(
            share(&[count("a", 2), count("b", 3)], &[(0, 10), (9, 10)]),
            [vec![1, 3], vec![1]]
        );
        assert_eq!(share(&[count("a", 3)], &[]), Vec::<Vec<u32>>::new());
    }

    #[test]
    fn who_was_sent_there_counts_until_a_report_shows_it() {
        let report = |ready| ServerReport {
            ready: vec![ReadyStatus {
                world: world("a"),
                mode: View::default(),
                wanted: 2,
                ready,
                starting: 0,
                problem: None,
            }],
            ..ServerReport::load_only(Load::ZERO)
        };
        let now = Instant::now();
        let mut worlds = ReadyWorlds::default();
        assert!(!worlds.has(&world("a")));
        worlds.report(&1, now, &report(2));
        worlds.report(&2, now, &report(1));
        assert_eq!((worlds.left(&1, &world("a")), worlds.left(&1, &world("b"))), (2, 0));
        worlds.place(&1, &world("a"), now);
        assert_eq!(worlds.left(&1, &world("a")), 1);
        worlds.report(&1, now + UNSEEN / 2, &report(2));
        assert_eq!(worlds.left(&1, &world("a")), 1, "it is on its way");
        worlds.report(&1, now + UNSEEN / 2, &report(1));
        assert_eq!(worlds.left(&1, &world("a")), 1, "it has taken one");
        worlds.place(&1, &world("a"), now);
        worlds.report(&1, now + UNSEEN, &report(1));
        assert_eq!(worlds.left(&1, &world("a")), 1, "it was refused");
        worlds.report(&1, now + UNSEEN, &report(0));
        worlds.lose(&2);
        assert_eq!((worlds.left(&1, &world("a")), worlds.left(&2, &world("a"))), (0, 0));
    }
}
