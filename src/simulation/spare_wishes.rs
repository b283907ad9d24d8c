//! What simulations are asked for to be kept ready, by the configuration and by session servers; and what prevents it.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use parking_lot::Mutex;

use super::slots::{LinkId, SpareKind};
use crate::shared::domain::{ReadyCount, ReadyEntry};

/// What is asked for. Of a world, the largest number that anybody asks for counts: session servers that share a
/// configuration ask for the same.
#[derive(Default)]
pub struct SpareWishes(Mutex<Board>);

#[derive(Default)]
struct Board {
    configured: Vec<ReadyEntry>,
    links: HashMap<LinkId, OfLink>,
    problems: BTreeMap<SpareKind, String>,
}

struct OfLink {
    counts: Vec<ReadyCount>,
    /// When its session server has left.
    gone: Option<Instant>,
}

/// Time for which the wishes of a session server hold that has left: it may be restarting.
const LINGER: Duration = Duration::from_mins(1);

impl SpareWishes {
    /// What the configuration asks for.
    pub fn configure(&self, entries: Vec<ReadyEntry>) {
        self.0.lock().configured = entries;
    }

    /// What a session server asks for. That replaces what it, and those that have left, have asked for before.
    pub fn ask(&self, link: LinkId, counts: Vec<ReadyCount>) {
        let mut board = self.0.lock();
        board.links.retain(|_, of_link| of_link.gone.is_none());
        board.links.insert(link, OfLink { counts, gone: None });
    }

    /// A session server has left.
    pub fn leave(&self, link: LinkId) {
        if let Some(of_link) = self.0.lock().links.get_mut(&link) {
            of_link.gone = Some(Instant::now());
        }
    }

    /// How many of each listed world are wanted at this time, by both clocks; 0 if it is listed for other times.
    pub fn wanted(&self, time: Timestamp, now: Instant) -> BTreeMap<SpareKind, u32> {
        let mut board = self.0.lock();
        board
            .links
            .retain(|_, of_link| of_link.gone.is_none_or(|gone| now.duration_since(gone) < LINGER));
        let configured = board
            .configured
            .iter()
            .filter(|entry| !entry.is_over(time))
            .map(|entry| {
                let kind = SpareKind {
                    world: entry.world.clone(),
                    view: entry.mode,
                };
                (kind, if entry.is_due(time) { entry.count } else { 0 })
            });
        let of_links = board.links.values().flat_map(|of_link| &of_link.counts).map(|one| {
            let kind = SpareKind {
                world: one.world.clone(),
                view: one.mode,
            };
            (kind, one.count)
        });
        let mut wanted: BTreeMap<SpareKind, u32> = BTreeMap::new();
        for (kind, count) in configured.chain(of_links) {
            let most = wanted.entry(kind).or_default();
            *most = count.max(*most);
        }
        wanted
    }

    /// Why a world can't be kept ready; `None`: it can.
    pub fn set_problem(&self, kind: &SpareKind, problem: Option<String>) {
        let problems = &mut self.0.lock().problems;
        match problem {
            Some(problem) => problems.insert(kind.clone(), problem),
            None => problems.remove(kind),
        };
    }

    /// Forgets the problems of other worlds.
    pub fn retain_problems(&self, is_listed: impl Fn(&SpareKind) -> bool) {
        self.0.lock().problems.retain(|kind, _| is_listed(kind));
    }

    /// Why worlds can't be kept ready.
    pub fn problems(&self) -> BTreeMap<SpareKind, String> {
        self.0.lock().problems.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::{ProjectUrl, View};

    #[test]
    fn the_largest_wish_counts_and_one_of_a_lost_server_holds_for_a_minute() {
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap();
        let kind = SpareKind {
            world: world.clone(),
            view: View::X3d,
        };
        let count = |count| {
            vec![ReadyCount {
                world: world.clone(),
                mode: View::X3d,
                count,
            }]
        };
        let wishes = SpareWishes::default();
        let wanted = |after| {
            wishes
                .wanted(Timestamp::now(), Instant::now() + Duration::from_secs(after))
                .get(&kind)
                .copied()
        };
        assert_eq!(wanted(0), None);
        wishes.ask(LinkId(1), count(3));
        wishes.ask(LinkId(2), count(5));
        assert_eq!(wanted(0), Some(5), "both ask for the same");
        wishes.leave(LinkId(2));
        assert_eq!(wanted(30), Some(5));
        // It comes back.
        wishes.ask(LinkId(3), count(4));
        assert_eq!(wanted(0), Some(4));
        wishes.leave(LinkId(3));
        wishes.leave(LinkId(1));
        assert_eq!(wanted(61), None);
        let entry = format!(
            r#"[{{"world": "{world}", "count": 2}}, {{"world": "{world}", "count": 9, "from": "2999-01-01"}}]"#
        );
        wishes.configure(serde_json::from_str(&entry).unwrap());
        assert_eq!(wanted(0), Some(2));
    }
}
