//! How fair a rehearsal was to those who waited, and how well the slots were used meanwhile. Pure.
//!
//! It follows from the visits alone, so that it is the same measure for every fleet: that of a fleet with a line, and of
//! one whose clients ask again and again.

use serde::Serialize;

use crate::real_time_factors::{quantile, sorted};
use crate::visit::Visit;

/// Clients that come within this time of each other, in seconds, overtake nobody, and nobody waits who waits for less:
/// this program learns of a turn a little later than the servers.
const TOLERANCE: f64 = 0.3;

/// What those who waited have experienced.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Line {
    /// Clients that waited.
    pub(crate) waited: u32,
    /// The largest number of clients ahead that one was told of when it came; `None` if the fleet tells nobody.
    pub(crate) longest: Option<u32>,
    /// Pairs of clients of which the second had its turn while the first still waited.
    pub(crate) overtakings: u32,
    /// The largest number of clients that overtook the same one.
    pub(crate) most_overtaken: u32,
    /// How long slots were free while somebody waited, in seconds, over all slots.
    pub(crate) idle: f64,
    /// Of the time in which somebody waited, the share for which a slot was free.
    pub(crate) idle_share: f64,
    /// The median and the longest time in which one slot was free while somebody waited, in seconds.
    pub(crate) idle_median: f64,
    /// See there.
    pub(crate) idle_worst: f64,
}

/// The use of a slot, or a client's time in the line.
#[derive(Debug, Clone, Copy)]
struct Span {
    from: f64,
    to: f64,
}

impl Span {
    fn overlap(self, other: Self) -> f64 {
        (self.to.min(other.to) - self.from.max(other.from)).max(0.0)
    }
}

impl Line {
    /// What these visits tell; `None` if nobody waited. A server has as many slots as were in use there at once.
    pub(crate) fn of(visits: &[Visit]) -> Option<Self> {
        let waits: Vec<Span> = visits
            .iter()
            .map(waiting)
            .filter(|wait| wait.to - wait.from > TOLERANCE)
            .collect();
        if waits.is_empty() {
            return None;
        }
        let overtaken: Vec<u32> = visits.iter().map(|visit| overtaken(visit, visits)).collect();
        let busy = busy(&waits);
        let gaps: Vec<f64> = gaps(visits).into_iter().map(|gap| within(gap, &busy)).collect();
        let slots: f64 = visits
            .iter()
            .filter_map(|visit| visit.server.as_ref())
            .collect::<std::collections::BTreeSet<_>>()
            .into_iter()
            .map(|server| f64::from(u32::try_from(slots(visits, server).len()).unwrap_or(u32::MAX)))
            .sum();
        let idle = gaps.iter().fold(0.0, |sum, gap| sum + gap);
        let all = slots * busy.iter().map(|span| span.to - span.from).sum::<f64>();
        let some = sorted(gaps.into_iter().filter(|gap| *gap > 0.0));
        Some(Self {
            waited: u32::try_from(waits.len()).unwrap_or(u32::MAX),
            longest: visits.iter().filter_map(|visit| visit.place).max(),
            overtakings: overtaken.iter().sum(),
            most_overtaken: overtaken.into_iter().max().unwrap_or_default(),
            idle,
            idle_share: if all > 0.0 { idle / all } else { 0.0 },
            idle_median: quantile(&some, 0.5).unwrap_or_default(),
            idle_worst: some.last().copied().unwrap_or_default(),
        })
    }
}

fn waiting(visit: &Visit) -> Span {
    Span {
        from: visit.asked,
        to: visit.turn.unwrap_or(visit.ended),
    }
}

/// Number of clients that came later than this one and had their turn while it waited.
fn overtaken(visit: &Visit, visits: &[Visit]) -> u32 {
    let own = waiting(visit);
    let by = visits.iter().filter(|other| {
        let came_later = other.asked > own.from;
        came_later && other.turn.is_some_and(|turn| turn + TOLERANCE < own.to)
    });
    u32::try_from(by.count()).unwrap_or(u32::MAX)
}

/// The times in which somebody waited.
fn busy(waits: &[Span]) -> Vec<Span> {
    let mut sorted = waits.to_vec();
    sorted.sort_by(|one, other| one.from.total_cmp(&other.from));
    let mut busy: Vec<Span> = Vec::new();
    for wait in sorted {
        match busy.last_mut() {
            Some(last) if wait.from <= last.to => last.to = last.to.max(wait.to),
            _ => busy.push(wait),
        }
    }
    busy
}

fn within(span: Span, others: &[Span]) -> f64 {
    others.iter().map(|other| span.overlap(*other)).sum()
}

/// The times for which slots were free between two clients.
fn gaps(visits: &[Visit]) -> Vec<Span> {
    let mut servers: Vec<&String> = visits.iter().filter_map(|visit| visit.server.as_ref()).collect();
    servers.sort_unstable();
    servers.dedup();
    let slots = servers.into_iter().flat_map(|server| slots(visits, server));
    slots.flat_map(|(_, gaps)| gaps).collect()
}

/// The slots of a server: until when each was used last, and when it was free between two uses. A client takes the slot
/// that was free the longest.
fn slots(visits: &[Visit], server: &String) -> Vec<(f64, Vec<Span>)> {
    let here = visits.iter().filter(|visit| visit.server.as_ref() == Some(server));
    let mut uses: Vec<Span> = here
        .filter_map(|visit| {
            let from = visit.turn?;
            Some(Span { from, to: visit.ended })
        })
        .collect();
    uses.sort_by(|one, other| one.from.total_cmp(&other.from));
    let mut slots: Vec<(f64, Vec<Span>)> = Vec::new();
    for used in uses {
        let free = slots.iter_mut().filter(|(until, _)| *until <= used.from);
        match free.min_by(|(one, _), (other, _)| one.total_cmp(other)) {
            Some((until, gaps)) => {
                gaps.push(Span {
                    from: *until,
                    to: used.from,
                });
                *until = used.to;
            }
            None => slots.push((used.to, Vec::new())),
        }
    }
    slots
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::behaviour::Behaviour;
    use crate::visit::{Outcome, Steps};

    fn visit(asked: f64, turn: Option<f64>, ended: f64) -> Visit {
        Visit {
            client: 0,
            behaviour: Behaviour::Ordinary,
            asked,
            server: Some("a:2000".to_owned()),
            place: None,
            turn,
            outcome: Outcome::Ran,
            steps: Steps::default(),
            pace: Vec::new(),
            ended,
        }
    }

    #[test]
    fn overtakings_and_free_slots_follow_from_the_visits() {
        // One slot. The third has its turn before the second, after the slot was free for two seconds; then it is free
        // for one. The fourth comes when nobody waits.
        let visits = [
            visit(0.0, Some(0.0), 10.0),
            visit(1.0, Some(21.0), 30.0),
            visit(2.0, Some(12.0), 20.0),
            visit(40.0, Some(40.1), 50.0),
        ];
        let line = Line::of(&visits).unwrap();
        assert_eq!((line.waited, line.overtakings, line.most_overtaken), (2, 1, 1));
        assert_eq!((line.idle, line.idle_median, line.idle_worst), (3.0, 1.0, 2.0));
        assert!((line.idle_share - 3.0 / 20.0).abs() < 1e-9, "{line:?}");
        assert_eq!(line.longest, None);
        let in_order = [
            visit(0.0, Some(0.0), 10.0),
            visit(1.0, Some(10.0), 20.0),
            visit(2.0, None, 15.0),
        ];
        let line = Line::of(&in_order).unwrap();
        assert_eq!((line.waited, line.overtakings, line.idle), (2, 0, 0.0));
        assert_eq!(Line::of(&in_order[..1]), None);
    }
}
