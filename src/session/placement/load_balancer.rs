//! The servers of the fleet, and the choice between them.

use super::backend::{Backend, Rank, count};
use super::cost::{Estimate, FleetCost};
use super::ejection::Ejection;
use super::policy::PlacementPolicy;
use super::replicas::Replicas;
use crate::shared::domain::{Admission, ServerReport};
use std::collections::{BTreeMap, HashMap};
use std::hash::Hash;
use std::time::{Duration, Instant};

/// The simulation servers, what is known of each, and the choice between them. `Id` identifies a server.
///
/// ```
/// use std::time::Instant;
/// use webots_fleet::session::placement::{LoadBalancer, PlacementPolicy};
/// use webots_fleet::shared::domain::{Load, ServerReport};
///
/// let now = Instant::now();
/// let mut fleet = LoadBalancer::new(PlacementPolicy::default());
/// for (id, load) in [("busy", 40.0), ("idle", 3.0)] {
///     fleet.add(id);
///     fleet.report(&id, now, &ServerReport::load_only(Load::try_from(load).unwrap()), true);
/// }
/// assert_eq!(fleet.pick(now, true, |_| true), Some("idle"));
/// assert_eq!(fleet.effective_load(&"idle"), Some(5.0));
/// ```
#[derive(Debug)]
pub struct LoadBalancer<Id> {
    policy: PlacementPolicy,
    servers: HashMap<Id, Backend>,
    /// The servers that have room, so that a choice among a thousand is as fast as one among ten. A server's rank is
    /// updated when it is probed or chosen, and every [`CHECK_INTERVAL`].
    ranking: BTreeMap<Rank, Id>,
    cost: FleetCost,
    replicas: Replicas,
    /// Number of picks.
    picks: u64,
    /// When the servers were last checked for placements and ejections that expire.
    checked: Option<Instant>,
}

/// Interval between checks for placements and ejections that expire.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);

impl<Id: Clone + Eq + Hash> LoadBalancer<Id> {
    /// A fleet without servers.
    pub fn new(policy: PlacementPolicy) -> Self {
        Self {
            policy,
            servers: HashMap::new(),
            ranking: BTreeMap::new(),
            cost: FleetCost::default(),
            replicas: Replicas::default(),
            picks: 0,
            checked: None,
        }
    }

    /// Changes the policy, which applies to a server when its rank is updated. What was learned of the servers stays.
    pub fn set_policy(&mut self, policy: PlacementPolicy) {
        self.policy = policy;
    }

    /// Adds a server, which is down until its first report. A known server is not changed.
    pub fn add(&mut self, id: Id) {
        self.picks += 1;
        self.servers
            .entry(id)
            .or_insert_with(|| Backend::new(&self.policy, self.picks));
    }

    /// Removes a server and all that was known of it.
    pub fn remove(&mut self, id: &Id) {
        if let Some(server) = self.servers.remove(id) {
            self.cost.replace(server.estimate, Estimate::default());
            server.rank.map(|rank| self.ranking.remove(&rank));
        }
    }

    /// Records what a server answered at `now`, and whether it takes new clients. If its last starts have failed for a
    /// reason of its own, other servers are preferred for a while. A server that is not in the fleet is ignored.
    pub fn report(&mut self, id: &Id, now: Instant, report: &ServerReport, accepting: bool) {
        let Some(server) = self.servers.get_mut(id) else { return };
        self.replicas.count(0.0, count(server.expire(now, &self.policy)));
        server.report(now, report, accepting, &self.policy, &mut self.cost, &mut self.replicas);
        sort_in(server, id, &self.policy, &mut self.ranking);
    }

    /// Records that a server does not answer: it gets no clients until its next report.
    pub fn lose(&mut self, id: &Id) {
        let Some(server) = self.servers.get_mut(id) else { return };
        server.up = false;
        sort_in(server, id, &self.policy, &mut self.ranking);
    }

    /// Returns the server for a client among those that have room, and counts the client as sent there. `admission` is
    /// on what terms a server takes the client at a load, in percent; `None` if it does not. A server that is
    /// [`Admission::Dedicated`] to it comes before one that shares its idle time, then the one with the lowest load, and
    /// of equal loads the one that was chosen longest ago. Ejected servers come last.
    ///
    /// A client that does not take room counts when servers are compared, but no number of such clients makes a server
    /// full before they have arrived.
    pub fn pick_admitted(
        &mut self,
        now: Instant,
        takes_room: bool,
        admission: impl Fn(&Id, f64) -> Option<Admission>,
    ) -> Option<Id> {
        self.expire(now);
        let id = self.first(admission)?.clone();
        self.picks += 1;
        let server = self.servers.get_mut(&id)?;
        server.last_pick = self.picks;
        server.add_placement(now, takes_room);
        sort_in(server, &id, &self.policy, &mut self.ranking);
        Some(id)
    }

    /// The same; servers on which a simulation is ready for the client come before all others.
    pub fn pick_ready_first(
        &mut self,
        now: Instant,
        takes_room: bool,
        has_ready: impl Fn(&Id) -> bool,
        admission: impl Fn(&Id, f64) -> Option<Admission>,
    ) -> Option<Id> {
        let of_ready = |id: &Id, load: f64| admission(id, load).filter(|_| has_ready(id));
        self.pick_admitted(now, takes_room, of_ready)
            .or_else(|| self.pick_admitted(now, takes_room, &admission))
    }

    /// Counts a client as sent to a server that has promised it a slot.
    pub fn place(&mut self, id: &Id, now: Instant) {
        let Some(server) = self.servers.get_mut(id) else { return };
        server.add_placement(now, true);
        sort_in(server, id, &self.policy, &mut self.ranking);
    }

    /// Takes back the last client that was counted as sent to a server.
    pub fn withdraw(&mut self, id: &Id) {
        let Some(server) = self.servers.get_mut(id) else { return };
        server.withdraw_placement();
        sort_in(server, id, &self.policy, &mut self.ranking);
    }

    /// Records that a server has no free slot, until its next report.
    pub fn fill(&mut self, id: &Id) {
        let Some(server) = self.servers.get_mut(id) else { return };
        server.is_filled = true;
        sort_in(server, id, &self.policy, &mut self.ranking);
    }

    /// Whether a server has room for one more client.
    pub fn has_room(&self, id: &Id) -> bool {
        self.servers.get(id).is_some_and(|server| server.rank.is_some())
    }

    /// Whether a server takes clients as soon as it has a free slot.
    pub fn would_take(&self, id: &Id) -> bool {
        self.servers
            .get(id)
            .is_some_and(|server| server.would_take(&self.policy))
    }

    /// As [`Self::pick_admitted`], among servers that are `eligible` on the same terms.
    pub fn pick(&mut self, now: Instant, takes_room: bool, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        self.pick_admitted(now, takes_room, |id, _| eligible(id).then_some(Admission::Dedicated))
    }

    fn first(&self, admission: impl Fn(&Id, f64) -> Option<Admission>) -> Option<&Id> {
        let mut shared: Option<(&Rank, &Id)> = None;
        for (rank, id) in &self.ranking {
            if shared.is_some_and(|(first, _)| first.comes_last != rank.comes_last) {
                // The others are ejected.
                break;
            }
            match admission(id, rank.load()) {
                Some(Admission::Dedicated) => return Some(id),
                Some(Admission::Shared) => {
                    shared.get_or_insert((rank, id));
                }
                None => {}
            }
        }
        shared.map(|(_, id)| id)
    }

    /// Gives up overdue placements, and ends ejections.
    fn expire(&mut self, now: Instant) {
        if self.checked.is_some_and(|checked| now < checked + CHECK_INTERVAL) {
            return;
        }
        self.checked = Some(now);
        let mut given_up = 0;
        for (id, server) in &mut self.servers {
            given_up += server.expire(now, &self.policy);
            sort_in(server, id, &self.policy, &mut self.ranking);
        }
        self.replicas.count(0.0, count(given_up));
    }

    /// Whether some server that is `eligible` at its load, in percent, can take a client.
    pub fn available(&mut self, now: Instant, eligible: impl Fn(&Id, f64) -> bool) -> bool {
        self.expire(now);
        self.ranking.iter().any(|(rank, id)| eligible(id, rank.load()))
    }

    /// Whether others are preferred to a server, because its last starts have failed.
    pub fn is_ejected(&self, id: &Id) -> bool {
        self.servers
            .get(id)
            .is_some_and(|server| server.ejection != Ejection::Closed)
    }

    /// The load, in percent, that is expected once it shows all clients that reserve room; `None` if the server is
    /// down.
    pub fn effective_load(&self, id: &Id) -> Option<f64> {
        self.servers.get(id)?.effective_load()
    }

    /// The load, in percent, from which a server gets no clients; `None` if it is not in the fleet.
    pub fn limit(&self, id: &Id) -> Option<f64> {
        self.servers.get(id).map(|server| server.limit(&self.policy))
    }

    /// Number of clients that were sent to a server and have neither been seen there nor been given up.
    pub fn in_flight(&self, id: &Id) -> usize {
        self.servers.get(id).map_or(0, |server| server.in_flight.len())
    }

    /// Expected cost of a client on a server, in percent of load; `None` if it is not in the fleet.
    pub fn client_cost(&self, id: &Id) -> Option<f64> {
        self.servers.get(id).map(|server| server.cost)
    }
}

/// Updates the rank of a server after a change.
fn sort_in<Id: Clone>(server: &mut Backend, id: &Id, policy: &PlacementPolicy, ranking: &mut BTreeMap<Rank, Id>) {
    let before = server.rank;
    let now = server.current_rank(policy);
    if before != now {
        before.map(|rank| ranking.remove(&rank));
        now.map(|rank| ranking.insert(rank, id.clone()));
        server.rank = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::{Instances, Load};
    use proptest::prelude::*;

    fn report(load: f64, instances: Option<Instances>) -> ServerReport {
        ServerReport {
            instances,
            ..ServerReport::load_only(Load::try_from(load).unwrap())
        }
    }

    fn instances(running: u32, slots: u32, arrivals: u64) -> Instances {
        Instances {
            running,
            slots,
            arrivals,
            ..Instances::default()
        }
    }

    fn load_only(load: f64) -> ServerReport {
        report(load, None)
    }

    fn full_report(load: f64, present: u32, arrivals: u64) -> ServerReport {
        report(load, Some(instances(present, 1000, arrivals)))
    }

    /// Servers 0, 1, ... with these reports.
    fn fleet(client_cost: f64, now: Instant, reports: impl IntoIterator<Item = ServerReport>) -> LoadBalancer<u32> {
        let mut fleet = LoadBalancer::new(PlacementPolicy {
            client_cost,
            ..PlacementPolicy::default()
        });
        for (id, report) in (0..).zip(reports) {
            fleet.add(id);
            fleet.report(&id, now, &report, true);
        }
        fleet
    }

    #[test]
    fn a_report_decides_whether_a_server_takes_clients() {
        let instances = |present, places| Some(instances(present, places, 7));
        for (why, load, instances, accepting, available) in [
            ("idle", 0.0, instances(0, 10), true, true),
            ("under the threshold", 94.9, instances(5, 10), true, true),
            ("at the threshold", 95.0, instances(5, 10), true, false),
            ("drained", 0.0, instances(0, 10), false, false),
            ("no place left", 10.0, instances(10, 10), true, false),
            ("more clients than places", 10.0, instances(12, 10), true, false),
            ("no places at all", 0.0, instances(0, 0), true, false),
            ("only a load", 3.0, None, true, true),
            ("only a load, and drained", 3.0, None, false, false),
        ] {
            let now = Instant::now();
            let mut fleet = fleet(2.0, now, []);
            fleet.add(0);
            fleet.report(&0, now, &report(load, instances), accepting);
            assert_eq!(fleet.available(now, |_, _| true), available, "{why}");
            assert_eq!(fleet.pick(now, true, |_| true).is_some(), available, "{why}");
        }
    }

    #[test]
    fn placements_without_room_close_no_server() {
        let now = Instant::now();
        for report in [|load| full_report(load, 0, 0), load_only] {
            let mut fleet = fleet(2.0, now, [10.0, 20.0, 30.0].map(report));
            let mut got = [0; 3];
            for step in 0..1500 {
                let at = now + Duration::from_millis(10 * step);
                if step % 100 == 0 {
                    (0..3).for_each(|id| fleet.report(&id, at, &report(10.0 * f64::from(id + 1)), true));
                }
                let id = fleet.pick(at, false, |_| true).unwrap();
                got[usize::try_from(id).unwrap()] += 1;
                assert!(fleet.available(at, |_, _| true));
            }
            assert!(got.iter().all(|got| (400..600).contains(got)), "{got:?}");
            let end = now + Duration::from_secs(15);
            (0..3).for_each(|id| fleet.report(&id, end, &report(10.0 * f64::from(id + 1)), true));
            assert_eq!(
                (0..3).map(|id| fleet.effective_load(&id)).collect::<Vec<_>>(),
                [10.0, 20.0, 30.0].map(Some)
            );
        }
    }

    #[test]
    fn a_client_without_room_that_has_come_takes_room() {
        let now = Instant::now();
        let mut fleet = fleet(2.0, now, [full_report(10.0, 0, 0)]);
        fleet.pick(now, false, |_| true);
        assert_eq!((fleet.effective_load(&0), fleet.in_flight(&0)), (Some(10.0), 1));
        fleet.report(&0, now, &full_report(10.0, 1, 1), true);
        assert_eq!((fleet.effective_load(&0), fleet.in_flight(&0)), (Some(12.0), 0));
    }

    #[test]
    fn servers_that_all_fail_alike_are_used_as_if_none_did() {
        let now = Instant::now();
        let mut fleet = fleet(
            2.0,
            now,
            [10.0, 20.0].map(|load| ServerReport {
                failed_starts: 5,
                ..load_only(load)
            }),
        );
        assert!(fleet.available(now, |_, _| true));
        assert_eq!(fleet.pick(now, true, |_| true), Some(0));
        assert_eq!(fleet.pick(now, true, |id| *id == 1), Some(1));
    }

    #[test]
    fn after_its_ejection_a_server_gets_one_client_until_a_start_succeeds() {
        let begin = Instant::now();
        let after = begin + Duration::from_secs(121);
        let failing = |failed_starts, starting, arrivals| ServerReport {
            failed_starts,
            ..report(
                1.0,
                Some(Instances {
                    starting,
                    slots: 100,
                    arrivals,
                    ..Instances::default()
                }),
            )
        };
        let mut fleet = fleet(2.0, begin, [failing(3, 0, 3), full_report(50.0, 0, 0)]);
        let three = |fleet: &mut LoadBalancer<u32>, at| {
            let picks = (0..3).filter_map(|_| fleet.pick(at, true, |_| true));
            picks.filter(|id| *id == 0).count()
        };
        assert_eq!(three(&mut fleet, begin), 0, "ejected");
        assert_eq!(three(&mut fleet, after), 1, "the trial");
        fleet.report(&0, after, &failing(3, 1, 4), true);
        assert_eq!(three(&mut fleet, after), 0, "it is starting");
        fleet.report(&0, after, &failing(3, 0, 4), true);
        assert_eq!(three(&mut fleet, after), 1, "it has left: another trial");
        fleet.report(&0, after, &failing(4, 0, 5), true);
        assert_eq!(three(&mut fleet, after), 0, "it has failed");
        fleet.report(&0, after, &failing(0, 0, 5), true);
        assert_eq!(three(&mut fleet, after), 3, "it has succeeded");
    }

    #[test]
    fn a_server_that_is_dedicated_to_a_world_comes_first_and_a_burst_exceeds_no_shared_idle_time() {
        let now = Instant::now();
        let mut fleet = fleet(2.0, now, [70.0, 41.0].map(load_only));
        // Server 0 is dedicated, server 1 shares its idle time up to 50 %.
        let admission = |id: &u32, load: f64| match id {
            0 => Some(Admission::Dedicated),
            _ => (load <= 50.0).then_some(Admission::Shared),
        };
        let picked: Vec<_> = (0..100)
            .map_while(|_| fleet.pick_admitted(now, true, admission))
            .collect();
        let (dedicated, shared) = picked.split_at(13);
        assert!(dedicated.iter().all(|id| *id == 0), "{picked:?}");
        assert_eq!(shared, [1; 5], "41, 43, 45, 47 and 49 %");
    }

    #[test]
    fn several_session_servers_share_the_fleet() {
        let now = Instant::now();
        let report = |clients: u32| report(1.0, Some(instances(clients, 500, clients.into())));
        let mut beside = [(); 2].map(|()| fleet(0.25, now, [report(0)]));
        for client in 0..300_u32 {
            let at = now + Duration::from_secs(client.into());
            beside[usize::from(client % 2 == 0)].pick(at, true, |_| true);
            for fleet in &mut beside {
                fleet.report(&0, at, &report(client + 1), true);
            }
        }
        let at = now + Duration::from_mins(5);
        let placed = beside.map(|mut fleet| std::iter::from_fn(|| fleet.pick(at, true, |_| true)).count());
        assert!(
            placed.iter().all(|placed| (95..=115).contains(placed)),
            "200 places are left: {placed:?}"
        );
    }

    #[test]
    fn a_session_server_that_is_alone_now_fills_the_fleet() {
        let now = Instant::now();
        let report = |arrivals| report(1.0, Some(instances(0, 20, arrivals)));
        let mut fleet = fleet(0.25, now, [report(0)]);
        // All of them were sent by other session servers.
        fleet.report(&0, now + Duration::from_secs(1), &report(1_000), true);
        let mut placed = 0;
        for second in 2..15 {
            let at = now + Duration::from_secs(second);
            placed += std::iter::from_fn(|| fleet.pick(at, true, |_| true)).count();
            fleet.report(&0, at, &report(1_000), true);
        }
        assert_eq!(placed, 20, "of 20 clients that wait for 20 places");
    }

    /// Sends this many clients at once; returns how many each server got.
    fn burst(fleet: &mut LoadBalancer<u32>, now: Instant, clients: usize, servers: u32) -> Vec<usize> {
        for _ in 0..clients {
            fleet.pick(now, true, |_| true);
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
            prop_assert_eq!(fleet.available(now, |_, _| true), lowest < 95.0);
        }

        #[test]
        fn whatever_is_reported_all_numbers_stay_sane(
            steps in prop::collection::vec(
                (0..3_u32, 0.0..20.0, prop::option::of((0..500_u32, 0..50_u32, any::<u64>())),
                 prop_oneof![4 => 0.0..110.0, 1 => 0.0..f64::MAX], 0..8_u8),
                1..200,
            )
        ) {
            let mut now = Instant::now();
            let mut fleet = fleet(2.0, now, []);
            (0..3).for_each(|id| fleet.add(id));
            for (id, pause, instances, load, action) in steps {
                now += Duration::from_secs_f64(pause);
                let counts = |(present, places, arrivals)| super::tests::instances(present, places, arrivals >> (arrivals % 64));
                match action {
                    0 => fleet.lose(&id),
                    1 => { fleet.remove(&id); fleet.add(id); }
                    2 => prop_assert_eq!(fleet.available(now, |_, _| true), fleet.pick(now, true, |_| true).is_some()),
                    3 => prop_assert_eq!(fleet.available(now, |_, _| true), fleet.pick(now, false, |_| true).is_some()),
                    _ => fleet.report(&id, now, &report(load, instances.map(counts)), action > 4),
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
