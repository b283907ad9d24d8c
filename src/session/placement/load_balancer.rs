//! The servers of the fleet, and the choice between them.

use super::backend::{Backend, LoadReport};
use super::cost::{Estimate, FleetCost};
use super::ejection::Ejection;
use super::policy::PlacementPolicy;
use super::ranking::{Rank, RankEntry, Ranking};
use super::replicas::Replicas;
use slab::Slab;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::hash::Hash;
use std::time::Instant;

/// The simulation servers, what is known of each, and the choice between them. `Id` is the owner's key of a server.
///
/// ```
/// use std::time::Instant;
/// use webots_fleet::session::placement::{LoadBalancer, PlacementPolicy, LoadReport};
///
/// let now = Instant::now();
/// let mut fleet = LoadBalancer::new(PlacementPolicy::default());
/// for (id, load) in [("busy", 40.0), ("idle", 3.0)] {
///     fleet.add(id);
///     fleet.report(&id, now, LoadReport { load, instances: None });
/// }
/// assert_eq!(fleet.pick(now, |_| true), Some("idle"));
/// assert_eq!(fleet.effective_load(&"idle"), Some(5.0));
/// ```
#[derive(Debug)]
pub struct LoadBalancer<Id> {
    policy: PlacementPolicy,
    /// By index, so that a choice neither compares nor hashes an `Id`: with a thousand servers each of these is
    /// elsewhere in memory.
    servers: Slab<Server<Id>>,
    numbers: HashMap<Id, usize>,
    cost: FleetCost,
    replicas: Replicas,
    ranking: Ranking,
    /// Number of picks.
    picks: u64,
}

#[derive(Debug)]
struct Server<Id> {
    id: Id,
    backend: Backend,
    ejection: Ejection,
    rank_entry: RankEntry,
}

impl<Id: Clone + Eq + Hash> LoadBalancer<Id> {
    /// A fleet without servers.
    pub fn new(policy: PlacementPolicy) -> Self {
        Self {
            policy,
            servers: Slab::new(),
            numbers: HashMap::new(),
            cost: FleetCost::default(),
            replicas: Replicas::default(),
            ranking: Ranking::default(),
            picks: 0,
        }
    }

    /// Changes the policy. What was learned of the servers stays.
    pub fn set_policy(&mut self, policy: PlacementPolicy) {
        self.policy = policy;
        for (number, server) in &mut self.servers {
            server.sort_in(number, &self.policy, &mut self.ranking);
        }
    }

    /// Adds a server, which is down until its first report. A known server is not changed.
    pub fn add(&mut self, id: Id) {
        self.picks += 1;
        if let Entry::Vacant(entry) = self.numbers.entry(id) {
            let (id, backend) = (entry.key().clone(), Backend::new(&self.policy, self.picks));
            let (ejection, rank_entry) = (Ejection::default(), RankEntry::default());
            entry.insert(self.servers.insert(Server { id, backend, ejection, rank_entry }));
        }
    }

    /// Removes a server and all that was known of it.
    pub fn remove(&mut self, id: &Id) {
        let Some(number) = self.numbers.remove(id) else { return };
        if let Some(server) = self.servers.try_remove(number) {
            self.cost.replace(server.backend.estimate(), Estimate::default());
            self.ranking.update(number, server.rank_entry, RankEntry::default());
        }
    }

    /// Records what a server answered at `now`. A server that is not in the fleet is ignored.
    pub fn report(&mut self, id: &Id, now: Instant, report: LoadReport) {
        let Some((number, server)) = find(&self.numbers, &mut self.servers, id) else { return };
        server.backend.expire(now, &self.policy, &mut self.replicas);
        server.backend.report(now, report, &self.policy, &mut self.cost, &mut self.replicas);
        server.sort_in(number, &self.policy, &mut self.ranking);
    }

    /// Records how many of a server's last starts in a row have failed for a reason of its own. After some, other
    /// servers are preferred for a while.
    pub fn note_failures(&mut self, id: &Id, now: Instant, failed: u32) {
        let Some((number, server)) = find(&self.numbers, &mut self.servers, id) else { return };
        server.ejection.expire(now);
        server.ejection.report(now, failed);
        server.sort_in(number, &self.policy, &mut self.ranking);
    }

    /// Whether others are preferred to a server, because its last starts have failed.
    pub fn is_ejected(&self, id: &Id) -> bool {
        self.server(id).is_some_and(|server| server.ejection.until().is_some())
    }

    /// Records that a server does not answer: it gets no clients until its next report.
    pub fn lose(&mut self, id: &Id) {
        let Some((number, server)) = find(&self.numbers, &mut self.servers, id) else { return };
        server.backend.lose();
        server.sort_in(number, &self.policy, &mut self.ranking);
    }

    /// Returns the server with the lowest load among those that have room and are `eligible`, and counts the client as
    /// sent there. Of servers with equal loads it is the one that was chosen longest ago; ejected servers come last.
    pub fn pick(&mut self, now: Instant, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        self.pick_from(now, true, eligible)
    }

    /// The same for a client that may never arrive. It counts when servers are compared, and reserves no room: any
    /// number of these does not make a server full before they have arrived.
    pub fn pick_unreserved(&mut self, now: Instant, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        self.pick_from(now, false, eligible)
    }

    fn pick_from(&mut self, now: Instant, takes_room: bool, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        self.expire(now);
        let is_eligible = |number: &usize| self.servers.get(*number).is_some_and(|server| eligible(&server.id));
        let number = self.ranking.servers().find(is_eligible)?;
        self.picks += 1;
        let server = self.servers.get_mut(number)?;
        server.backend.last_pick = self.picks;
        server.backend.add_placement(now, takes_room);
        server.ejection.note_pick(now);
        server.sort_in(number, &self.policy, &mut self.ranking);
        Some(server.id.clone())
    }

    /// Gives up overdue placements, and ends ejections.
    fn expire(&mut self, now: Instant) {
        for number in self.ranking.expired(now).collect::<Vec<_>>() {
            if let Some(server) = self.servers.get_mut(number) {
                server.ejection.expire(now);
                server.backend.expire(now, &self.policy, &mut self.replicas);
                server.sort_in(number, &self.policy, &mut self.ranking);
            }
        }
    }

    /// Whether some server can take a client.
    pub fn available(&mut self, now: Instant) -> bool {
        self.expire(now);
        self.ranking.servers().next().is_some()
    }

    /// The load, in percent, that is expected once it shows all clients that reserve room; `None` if the server is
    /// down.
    pub fn effective_load(&self, id: &Id) -> Option<f64> {
        self.backend(id)?.effective_load()
    }

    /// The load, in percent, from which on a server gets no client; `None` if it is not in the fleet.
    pub fn limit(&self, id: &Id) -> Option<f64> {
        self.backend(id).map(|server| server.limit(&self.policy))
    }

    /// Number of clients that were sent to a server and have neither been seen there nor been given up.
    pub fn in_flight(&self, id: &Id) -> usize {
        self.backend(id).map_or(0, Backend::in_flight)
    }

    /// Expected cost of a client on a server, in percent of load; `None` if it is not in the fleet.
    pub fn client_cost(&self, id: &Id) -> Option<f64> {
        self.backend(id).map(Backend::cost)
    }

    fn backend(&self, id: &Id) -> Option<&Backend> {
        self.server(id).map(|server| &server.backend)
    }

    fn server(&self, id: &Id) -> Option<&Server<Id>> {
        self.servers.get(*self.numbers.get(id)?)
    }
}

fn find<'servers, Id: Eq + Hash>(
    numbers: &HashMap<Id, usize>,
    servers: &'servers mut Slab<Server<Id>>,
    id: &Id,
) -> Option<(usize, &'servers mut Server<Id>)> {
    let number = *numbers.get(id)?;
    Some((number, servers.get_mut(number)?))
}

impl<Id> Server<Id> {
    /// Updates the rank of a server after a change.
    fn sort_in(&mut self, number: usize, policy: &PlacementPolicy, ranking: &mut Ranking) {
        let load = self.backend.rank_load().filter(|_| self.backend.has_room(policy));
        let until = self.ejection.until();
        let rank = load.map(|load| Rank { is_ejected: until.is_some(), load, last_pick: self.backend.last_pick });
        let expiry = self.backend.next_expiry(policy).into_iter().chain(until).min();
        let entry = RankEntry { rank, expiry };
        ranking.update(number, std::mem::replace(&mut self.rank_entry, entry), entry);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::placement::ClientCounts;
    use proptest::prelude::*;
    use std::time::Duration;

    fn load_only(load: f64) -> LoadReport {
        LoadReport { load, instances: None }
    }

    /// Servers 0, 1, ... with these reports.
    fn fleet(client_cost: f64, now: Instant, reports: impl IntoIterator<Item = LoadReport>) -> LoadBalancer<u32> {
        let mut fleet = LoadBalancer::new(PlacementPolicy { client_cost, ..PlacementPolicy::default() });
        for (id, report) in (0..).zip(reports) {
            fleet.add(id);
            fleet.report(&id, now, report);
        }
        fleet
    }

    #[test]
    fn a_report_decides_whether_a_server_takes_clients() {
        let instances = |present, places, accepting| Some(ClientCounts { present, places, arrivals: 7, accepting });
        for (why, load, instances, available) in [
            ("idle", 0.0, instances(0, 10, true), true),
            ("under the threshold", 94.9, instances(5, 10, true), true),
            ("at the threshold", 95.0, instances(5, 10, true), false),
            ("drained", 0.0, instances(0, 10, false), false),
            ("no place left", 10.0, instances(10, 10, true), false),
            ("more clients than places", 10.0, instances(12, 10, true), false),
            ("no places at all", 0.0, instances(0, 0, true), false),
            ("not a number", f64::NAN, instances(0, 10, true), false),
            ("infinite", f64::INFINITY, None, false),
            ("negative", -1.0, None, false),
            ("only a load", 3.0, None, true),
        ] {
            let now = Instant::now();
            let mut fleet = fleet(2.0, now, [LoadReport { load, instances }]);
            assert_eq!(fleet.available(now), available, "{why}");
            assert_eq!(fleet.pick(now, |_| true).is_some(), available, "{why}");
        }
    }

    #[test]
    fn placements_without_room_close_no_server_and_are_spread_like_others() {
        let now = Instant::now();
        for report in [load_only as fn(f64) -> LoadReport, |load| LoadReport::of(load, 0, 1000, 0)] {
            let mut fleet = fleet(2.0, now, [10.0, 20.0, 30.0].map(report));
            let mut got = [0; 3];
            for step in 0..1500 {
                let at = now + Duration::from_millis(10 * step);
                if step % 100 == 0 {
                    (0..3).for_each(|id| fleet.report(&id, at, report(10.0 * f64::from(id + 1))));
                }
                let id = fleet.pick_unreserved(at, |_| true).unwrap();
                got[usize::try_from(id).unwrap()] += 1;
                assert!(fleet.available(at));
            }
            assert!(got.iter().all(|got| (400..600).contains(got)), "{got:?}");
            let end = now + Duration::from_secs(15);
            (0..3).for_each(|id| fleet.report(&id, end, report(10.0 * f64::from(id + 1))));
            assert_eq!((0..3).map(|id| fleet.effective_load(&id)).collect::<Vec<_>>(), [10.0, 20.0, 30.0].map(Some));
        }
    }

    #[test]
    fn a_client_without_room_that_has_come_takes_room() {
        let now = Instant::now();
        let mut fleet = fleet(2.0, now, [LoadReport::of(10.0, 0, 1000, 0)]);
        fleet.pick_unreserved(now, |_| true);
        assert_eq!((fleet.effective_load(&0), fleet.in_flight(&0)), (Some(10.0), 1));
        fleet.report(&0, now, LoadReport::of(10.0, 1, 1000, 1));
        assert_eq!((fleet.effective_load(&0), fleet.in_flight(&0)), (Some(12.0), 0));
    }

    #[test]
    fn servers_that_all_fail_alike_are_used_as_if_none_did() {
        let now = Instant::now();
        let mut fleet = fleet(2.0, now, [load_only(10.0), load_only(20.0)]);
        (0..2).for_each(|id| fleet.note_failures(&id, now, 5));
        assert!(fleet.available(now));
        assert_eq!(fleet.pick(now, |_| true), Some(0));
        assert_eq!(fleet.pick(now, |id| *id == 1), Some(1));
    }

    #[test]
    fn session_servers_side_by_side_do_not_each_fill_the_fleet_alone() {
        let now = Instant::now();
        let report = |clients: u32| LoadReport::of(1.0, clients, 500, clients.into());
        let mut beside = [(); 2].map(|()| fleet(0.25, now, [report(0)]));
        for client in 0..300_u32 {
            let at = now + Duration::from_secs(client.into());
            beside[usize::from(client % 2 == 0)].pick(at, |_| true);
            for fleet in &mut beside {
                fleet.report(&0, at, report(client + 1));
            }
        }
        let at = now + Duration::from_mins(5);
        let placed = beside.map(|mut fleet| std::iter::from_fn(|| fleet.pick(at, |_| true)).count());
        assert!(placed.iter().all(|placed| (95..=115).contains(placed)), "200 places are left: {placed:?}");
    }

    #[test]
    fn a_session_server_that_is_alone_now_fills_the_fleet_all_the_same() {
        let now = Instant::now();
        let report = |arrivals| LoadReport::of(1.0, 0, 20, arrivals);
        let mut fleet = fleet(0.25, now, [report(0)]);
        // All of them were sent by other session servers.
        fleet.report(&0, now + Duration::from_secs(1), report(1_000));
        let mut placed = 0;
        for second in 2..15 {
            let at = now + Duration::from_secs(second);
            placed += std::iter::from_fn(|| fleet.pick(at, |_| true)).count();
            fleet.report(&0, at, report(1_000));
        }
        assert_eq!(placed, 20, "of 20 clients that wait for 20 places");
    }

    /// Sends this many clients at once; returns how many each server got.
    fn burst(fleet: &mut LoadBalancer<u32>, now: Instant, clients: usize, servers: u32) -> Vec<usize> {
        for _ in 0..clients {
            fleet.pick(now, |_| true);
        }
        (0..servers).map(|id| fleet.in_flight(&id)).collect()
    }

    proptest! {
        #[test]
        fn a_burst_over_unequal_servers_ends_level(loads in prop::collection::vec(0.0..94.0, 1..40), clients in 0..2000_usize) {
            let now = Instant::now();
            let servers = u32::try_from(loads.len()).unwrap();
            let mut fleet = fleet(2.0, now, loads.into_iter().map(load_only));
            let placed = burst(&mut fleet, now, clients, servers);
            let level = |id| fleet.effective_load(&id).unwrap();
            let lowest = (0..servers).map(level).fold(f64::INFINITY, f64::min);
            for (id, placed) in (0..).zip(placed) {
                // A server that got a client is at most one client above the least loaded.
                prop_assert!(placed == 0 || level(id) <= lowest + 2.0 + 1e-9);
                prop_assert!(level(id) < 95.0 + 2.0);
            }
            prop_assert_eq!(fleet.available(now), lowest < 95.0);
        }

        #[test]
        fn whatever_is_reported_all_numbers_stay_sane(
            steps in prop::collection::vec(
                (0..3_u32, 0.0..20.0, prop::option::of((0..500_u32, 0..50_u32, any::<u64>(), any::<bool>())),
                 prop_oneof![4 => 0.0..110.0, 1 => any::<f64>()], 0..7_u8),
                1..200,
            )
        ) {
            let mut now = Instant::now();
            let mut fleet = fleet(2.0, now, []);
            (0..3).for_each(|id| fleet.add(id));
            for (id, pause, instances, load, action) in steps {
                now += Duration::from_secs_f64(pause);
                let instances = instances.map(|(present, places, arrivals, accepting)| {
                    ClientCounts { present, places, arrivals: arrivals >> (arrivals % 64), accepting }
                });
                match action {
                    0 => fleet.lose(&id),
                    1 => { fleet.remove(&id); fleet.add(id); }
                    2 => prop_assert_eq!(fleet.available(now), fleet.pick(now, |_| true).is_some()),
                    3 => prop_assert_eq!(fleet.available(now), fleet.pick_unreserved(now, |_| true).is_some()),
                    _ => fleet.report(&id, now, LoadReport { load, instances }),
                }
                for id in 0..3 {
                    let cost = fleet.client_cost(&id).unwrap();
                    prop_assert!((0.25..=50.0).contains(&cost), "cost {}", cost);
                    prop_assert!(fleet.effective_load(&id).is_none_or(|load| load >= 0.0));
                }
            }
        }
    }
}
