//! The servers of the fleet, and the choice between them.

use super::allowance::Allowances;
use super::cost::{Common, Estimate};
use super::order::{Order, Rank};
use super::policy::Policy;
use super::server::{Report, Server};
use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Instant;

/// The simulation servers, what is known of each, and the choice between them. `Id` is whatever the owner knows a server
/// by.
///
/// ```
/// use std::time::Instant;
/// use crate::session::placement::{Fleet, Policy, Report};
///
/// let now = Instant::now();
/// let mut fleet = Fleet::new(Policy::default());
/// for (id, load) in [("busy", 40.0), ("idle", 3.0)] {
///     fleet.add(id);
///     fleet.report(&id, now, Report { load, instances: None });
/// }
/// assert_eq!(fleet.place(now, |_| true), Some("idle"));
/// assert_eq!(fleet.effective_load(&"idle", now), Some(5.0));
/// ```
#[derive(Debug)]
pub struct Fleet<Id> {
    policy: Policy,
    servers: BTreeMap<Id, Server>,
    common: Common,
    allowances: Allowances,
    order: Order<Id>,
    turns: u64,
}

impl<Id: Clone + Ord> Fleet<Id> {
    /// A fleet without servers.
    #[must_use]
    pub fn new(policy: Policy) -> Self {
        Self {
            policy,
            servers: BTreeMap::new(),
            common: Common::new(),
            allowances: Allowances::default(),
            order: Order::new(),
            turns: 0,
        }
    }

    /// Changes the policy for all that follows. What servers have learned by the `initial_cost` until now stays.
    pub fn set_policy(&mut self, now: Instant, policy: Policy) {
        self.policy = policy;
        for id in self.servers.keys().cloned().collect::<Vec<_>>() {
            self.rank(&id, now);
        }
    }

    /// Adds a server, which is down until its first report. One that is there already stays as it is.
    pub fn add(&mut self, id: Id) {
        self.turns += 1;
        self.servers.entry(id).or_insert_with(|| Server::new(&self.policy, self.turns));
    }

    /// Removes a server and all that was known of it.
    pub fn remove(&mut self, id: &Id) {
        if let Some(server) = self.servers.remove(id) {
            self.common.replace(server.estimate(), Estimate::default());
            self.order.remove(id);
        }
    }

    /// A server answered at `now`. Says nothing of a server that is not in the fleet.
    pub fn report(&mut self, id: &Id, now: Instant, report: Report) {
        if let Some(server) = self.servers.get_mut(id) {
            server.report(now, report, &self.policy, (&mut self.common, &mut self.allowances));
            self.rank(id, now);
        }
    }

    /// A server does not answer: it takes no clients until its next report.
    pub fn lose(&mut self, id: &Id) {
        if let Some(server) = self.servers.get_mut(id) {
            server.lose();
            self.order.put(id, None, None);
        }
    }

    /// Chooses the server of least effective load among those that have room and are `eligible`, and counts the client as
    /// sent there. Of equal servers the one is taken that has waited longest for its turn.
    pub fn place(&mut self, now: Instant, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        self.place_from(now, None, eligible)
    }

    /// Does the same for a client of this address: of an address whose clients have not come lately only few count.
    pub fn place_from(&mut self, now: Instant, from: Option<IpAddr>, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        for id in self.order.expired(now).cloned().collect::<Vec<_>>() {
            if let Some(server) = self.servers.get_mut(&id) {
                server.forget_missing(now, &self.policy, &mut self.allowances);
            }
            self.rank(&id, now);
        }
        let least_loaded = self.order.servers().find(|id| eligible(id))?.clone();
        let counts = from.is_none_or(|from| self.allowances.take(from, now, self.policy.patience));
        let id = if counts { least_loaded } else { self.next_in_turn(eligible).unwrap_or(least_loaded) };
        self.turns += 1;
        let server = self.servers.get_mut(&id)?;
        server.turn = self.turns;
        if counts {
            server.place(now, from);
        }
        self.rank(&id, now);
        Some(id)
    }

    /// The server that has waited longest for its turn. Clients that don't count change no load, and would all go to one.
    fn next_in_turn(&self, eligible: impl Fn(&Id) -> bool) -> Option<Id> {
        let turn = |id: &&Id| self.servers.get(id).map(|server| server.turn);
        self.order.servers().filter(|id| eligible(id)).min_by_key(turn).cloned()
    }

    /// Puts a server in its place after something happened to it.
    fn rank(&mut self, id: &Id, now: Instant) {
        let Some(server) = self.servers.get(id) else {
            return;
        };
        let load = server.effective_load_if_room(now, &self.policy);
        let rank = load.map(|load| Rank { load, turn: server.turn });
        // A server that is down has no room whatever expires.
        let expiry = server.load().and_then(|_| server.next_expiry(now, &self.policy));
        self.order.put(id, rank, expiry);
    }

    fn has_room(&self, id: &Id, now: Instant) -> bool {
        self.servers.get(id).is_some_and(|server| server.effective_load_if_room(now, &self.policy).is_some())
    }

    /// Whether some server can take a client.
    #[must_use]
    pub fn available(&self, now: Instant) -> bool {
        // What expires leaves only more room.
        self.order.servers().next().is_some() || self.order.expired(now).any(|id| self.has_room(id, now))
    }

    /// When placements are given up next: the one moment at which availability can change without a call to this fleet.
    #[must_use]
    pub fn next_change(&self, now: Instant) -> Option<Instant> {
        let expired = self.order.expired(now).filter_map(|id| self.servers.get(id)?.next_expiry(now, &self.policy));
        expired.chain(self.order.next_expiry(now)).min()
    }

    /// The load that a server will have once all that was sent to it shows, in percent; `None` if it is down.
    #[must_use]
    pub fn effective_load(&self, id: &Id, now: Instant) -> Option<f64> {
        self.servers.get(id)?.effective_load(now, &self.policy)
    }

    /// The load from which on a server takes no client, in percent; `None` if the fleet does not have that server.
    #[must_use]
    pub fn limit(&self, id: &Id) -> Option<f64> {
        self.servers.get(id).map(|server| server.limit(&self.policy))
    }

    /// How many clients have been sent to a server and not been seen there yet.
    #[must_use]
    pub fn in_flight(&self, id: &Id, now: Instant) -> usize {
        self.servers.get(id).map_or(0, |server| server.in_flight(now, &self.policy))
    }

    /// What a client is expected to cost a server, in percent; `None` if the fleet does not have that server.
    #[must_use]
    pub fn learned_cost(&self, id: &Id) -> Option<f64> {
        self.servers.get(id).map(Server::learned_cost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::placement::Instances;
    use proptest::prelude::*;
    use std::time::Duration;

    fn policy(initial_cost: f64) -> Policy {
        Policy { initial_cost, ..Policy::default() }
    }

    fn load_only(load: f64) -> Report {
        Report { load, instances: None }
    }

    fn full_report(load: f64, present: u32, arrivals: u64) -> Report {
        let instances = Instances { present, places: 1000, arrivals, accepting: true };
        Report { load, instances: Some(instances) }
    }

    fn seconds(seconds: f64) -> Duration {
        Duration::from_secs_f64(seconds)
    }

    fn fleet_of_one(now: Instant, report: Report) -> Fleet<u32> {
        let mut fleet = Fleet::new(Policy::default());
        fleet.add(0);
        fleet.report(&0, now, report);
        fleet
    }

    fn assert_near(value: Option<f64>, expected: f64, tolerance: f64) {
        assert!(value.is_some_and(|value| (value - expected).abs() <= tolerance), "{value:?} is not {expected}");
    }

    #[test]
    fn a_server_takes_clients_from_its_first_report_until_it_is_lost_or_removed() {
        let now = Instant::now();
        let mut fleet = Fleet::new(Policy::default());
        assert!(!fleet.available(now));
        fleet.add("a");
        assert!(!fleet.available(now));
        assert_eq!(fleet.place(now, |_| true), None);
        fleet.report(&"a", now, load_only(20.0));
        assert!(fleet.available(now));
        assert_eq!(fleet.place(now, |_| true), Some("a"));
        fleet.lose(&"a");
        assert!(!fleet.available(now));
        assert_eq!(fleet.effective_load(&"a", now), None);
        fleet.report(&"a", now, load_only(20.0));
        assert!(fleet.available(now));
        fleet.remove(&"a");
        assert_eq!((fleet.available(now), fleet.learned_cost(&"a")), (false, None));
        fleet.report(&"unknown", now, load_only(20.0));
        assert!(!fleet.available(now));
    }

    #[test]
    fn only_an_eligible_server_is_chosen() {
        let now = Instant::now();
        let mut fleet = Fleet::new(Policy::default());
        for (id, load) in [("a", 1.0), ("b", 50.0)] {
            fleet.add(id);
            fleet.report(&id, now, load_only(load));
        }
        assert_eq!(fleet.place(now, |id| *id != "a"), Some("b"));
        assert_eq!(fleet.place(now, |_| false), None);
    }

    #[test]
    fn a_report_decides_whether_a_server_takes_clients() {
        let instances = |present, places, accepting| Some(Instances { present, places, arrivals: 7, accepting });
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
            let mut fleet = fleet_of_one(now, Report { load, instances });
            assert_eq!(fleet.available(now), available, "{why}");
            assert_eq!(fleet.place(now, |_| true).is_some(), available, "{why}");
        }
    }

    #[test]
    fn placements_in_flight_use_up_places_and_load() {
        let now = Instant::now();
        let mut report = full_report(0.0, 8, 8);
        report.instances = report.instances.map(|instances| Instances { places: 10, ..instances });
        let mut fleet = fleet_of_one(now, report);
        assert_eq!([(); 3].map(|()| fleet.place(now, |_| true)), [Some(0), Some(0), None]);

        let mut fleet = fleet_of_one(now, load_only(90.0));
        assert_eq!([(); 4].map(|()| fleet.place(now, |_| true)), [Some(0), Some(0), Some(0), None]);
        assert_eq!(fleet.effective_load(&0, now), Some(96.0));
    }

    #[test]
    fn a_client_must_fit_into_what_the_machine_has() {
        let now = Instant::now();
        let mut fleet = Fleet::new(policy(20.0));
        fleet.add(0);
        fleet.report(&0, now, load_only(79.0));
        assert!(fleet.available(now));
        fleet.report(&0, now, load_only(81.0));
        assert!(!fleet.available(now));
    }

    #[test]
    fn a_client_that_never_comes_is_given_up() {
        let now = Instant::now();
        let mut fleet = fleet_of_one(now, full_report(92.9, 10, 10));
        assert_eq!(fleet.next_change(now), None);
        fleet.place(now, |_| true);
        fleet.place(now + seconds(1.0), |_| true);
        assert_eq!(fleet.in_flight(&0, now + seconds(14.9)), 2);
        assert!(!fleet.available(now + seconds(1.0)));
        assert_eq!(fleet.next_change(now + seconds(1.0)), Some(now + seconds(15.0)));
        assert_eq!(fleet.in_flight(&0, now + seconds(15.0)), 1);
        assert_eq!(fleet.next_change(now + seconds(15.0)), Some(now + seconds(16.0)));
        assert_eq!(fleet.in_flight(&0, now + seconds(16.0)), 0);
        assert!(fleet.available(now + seconds(16.0)));
        assert_eq!(fleet.next_change(now + seconds(16.0)), None);
    }

    #[test]
    fn an_address_whose_clients_never_come_closes_no_fleet() {
        let start = Instant::now();
        let mut fleet = Fleet::new(Policy::default());
        let stranger = Some("203.0.113.9".parse().unwrap());
        (0..2).for_each(|id| fleet.add(id));
        let mut closed = 0;
        for tenth in 0..1_200 {
            let now = start + seconds(f64::from(tenth) / 10.0);
            if tenth % 10 == 0 {
                (0..2).for_each(|id| fleet.report(&id, now, full_report(10.0, 0, 0)));
            }
            // Ten requests a second: 150 within the patience, which two servers have no room for.
            fleet.place_from(now, stranger, |_| true);
            closed += i32::from(!fleet.available(now));
        }
        assert!((0..=150).contains(&closed), "closed for {closed} tenths of a second");
        let now = start + seconds(120.0);
        assert!(fleet.in_flight(&0, now) + fleet.in_flight(&1, now) <= 1);
        // Those of another address count as ever.
        let placed = [(); 4].map(|()| fleet.place_from(now, Some("203.0.113.10".parse().unwrap()), |_| true));
        assert!(placed.iter().all(Option::is_some), "{placed:?}");
        assert!(fleet.in_flight(&0, now) + fleet.in_flight(&1, now) >= 4);
    }

    #[test]
    fn an_address_whose_clients_never_come_closes_no_fleet_of_loads_alone() {
        let start = Instant::now();
        let mut fleet = Fleet::new(Policy::default());
        let stranger = Some("203.0.113.9".parse().unwrap());
        (0..2).for_each(|id| fleet.add(id));
        let (mut closed_early, mut closed_late) = (0, 0);
        for tenth in 0..3_000 {
            let now = start + seconds(f64::from(tenth) / 10.0);
            if tenth % 10 == 0 {
                (0..2).for_each(|id| fleet.report(&id, now, load_only(10.0)));
            }
            // Fifty requests a second: 200 are half settled at a time, and there is room for 85.
            for _ in 0..5 {
                fleet.place_from(now, stranger, |_| true);
            }
            let closed = if tenth < 400 { &mut closed_early } else { &mut closed_late };
            *closed += i32::from(!fleet.available(now));
        }
        assert!(closed_early > 0, "there was room for all, which tests nothing");
        assert_eq!(closed_late, 0, "of 2,600 tenths of a second");
        // Others count, if only with the least that is believed of them.
        let now = start + seconds(300.0);
        let before = fleet.effective_load(&0, now).unwrap() + fleet.effective_load(&1, now).unwrap();
        for _ in 0..20 {
            fleet.place_from(now, Some("203.0.113.10".parse().unwrap()), |_| true);
        }
        let after = fleet.effective_load(&0, now).unwrap() + fleet.effective_load(&1, now).unwrap();
        assert!(after - before >= 20.0 * 0.8 - 0.01, "from {before} to {after}");
    }

    #[test]
    fn a_class_whose_worlds_take_long_to_start_counts_on() {
        let start = Instant::now();
        let mut fleet = Fleet::new(Policy::default());
        let school = Some("203.0.113.9".parse().unwrap());
        (0..5).for_each(|id| fleet.add(id));
        for second in 0..60 {
            let now = start + seconds(f64::from(second));
            // Checked out for twelve seconds, in the load five later, and gone after forty.
            let shown = if second < 40 { (f64::from(second - 12) / 5.0).clamp(0.0, 1.0) } else { 0.0 };
            (0..5).for_each(|id| fleet.report(&id, now, load_only(3.0 + 80.0 * shown)));
            if second == 1 {
                (0..200).for_each(|_| assert!(fleet.place_from(now, school, |_| true).is_some()));
            }
        }
        let now = start + seconds(60.0);
        let placed = (0..1000).filter(|_| fleet.place_from(now, school, |_| true).is_some()).count();
        assert!((200..=245).contains(&placed), "{placed} where 235 fit");
    }

    #[test]
    fn a_class_that_shows_in_the_load_alone_counts_on() {
        let start = Instant::now();
        let mut fleet = fleet_of_one(start, load_only(3.0));
        let school = Some("203.0.113.9".parse().unwrap());
        for second in 0..30 {
            let now = start + seconds(f64::from(second));
            if second < 15 {
                (0..2).for_each(|_| assert!(fleet.place_from(now, school, |_| true).is_some()));
            }
            // They come within a second, and their load within five.
            let shown: f64 = (0..15).map(|at| (f64::from(second - at - 1) / 5.0).clamp(0.0, 1.0)).sum();
            fleet.report(&0, now, load_only(3.0 + 2.0 * 2.0 * shown));
        }
        let now = start + seconds(30.0);
        let before = fleet.effective_load(&0, now).unwrap();
        for _ in 0..10 {
            fleet.place_from(now, school, |_| true);
        }
        assert_near(fleet.effective_load(&0, now).map(|after| after - before), 20.0, 5.0);
    }

    #[test]
    fn a_class_of_which_a_few_never_came_counts_the_next_time() {
        let start = Instant::now();
        let mut fleet = Fleet::new(Policy::default());
        let school = Some("203.0.113.9".parse().unwrap());
        (0..10).for_each(|id| fleet.add(id));
        let report = |fleet: &mut Fleet<u32>, at: f64, present: u32, arrivals| {
            let now = start + seconds(at);
            let load = 3.0 + 2.0 * f64::from(present);
            (0..10).for_each(|id| fleet.report(&id, now, full_report(load, present, arrivals)));
            now
        };
        // Of 200 one in twenty never comes; the others have left long before the next class.
        let now = report(&mut fleet, 0.0, 0, 0);
        (0..200).for_each(|_| assert!(fleet.place_from(now, school, |_| true).is_some()));
        for (at, present) in [(10.0, 19), (20.0, 19), (60.0, 0), (300.0, 0)] {
            report(&mut fleet, at, present, 19);
        }
        let now = start + seconds(300.0);
        let placed = (0..2_000).take_while(|_| fleet.place_from(now, school, |_| true).is_some()).count();
        assert!((400..600).contains(&placed), "there is room for some 460, and {placed} were placed");
    }

    #[test]
    fn a_class_whose_simulations_start_slowly_counts_on() {
        let start = Instant::now();
        let mut fleet = fleet_of_one(start, load_only(3.0));
        let school = Some("203.0.113.9".parse().unwrap());
        // A checkout takes a while: nothing of thirty clients shows for ten seconds, then all of them.
        for second in 0..120 {
            let now = start + seconds(f64::from(second));
            if second == 1 {
                (0..30).for_each(|_| assert!(fleet.place_from(now, school, |_| true).is_some()));
            }
            let shown = (f64::from(second - 11) / 5.0).clamp(0.0, 1.0) - (f64::from(second - 90) / 5.0).clamp(0.0, 1.0);
            fleet.report(&0, now, load_only(3.0 + 60.0 * shown));
        }
        // The next class: there is room for some 46.
        let now = start + seconds(120.0);
        let placed = (0..1_000).take_while(|_| fleet.place_from(now, school, |_| true).is_some()).count();
        assert!((30..70).contains(&placed), "{placed} placed at {:?} % each", fleet.learned_cost(&0));
    }

    #[test]
    fn those_over_the_allowance_are_spread_all_the_same() {
        let now = Instant::now();
        let mut fleet = Fleet::new(policy(0.25));
        for (id, load) in [(0_usize, 10.0), (1, 11.0), (2, 12.0)] {
            fleet.add(id);
            fleet.report(&id, now, full_report(load, 0, 0));
        }
        let class = Some("203.0.113.9".parse().unwrap());
        let mut got = [0; 3];
        // More than the three have room for if all counted, and more than the allowance; those it takes fill the fleet.
        for step in 0..4_000 {
            let now = now + seconds(f64::from(step) / 1_000.0);
            if let Some(id) = fleet.place_from(now, class, |_| true) {
                got[id] += 1;
            }
        }
        let (least, most) = (got.iter().min().unwrap(), got.iter().max().unwrap());
        assert!(most - least <= 12, "{got:?}");
    }

    #[test]
    fn a_client_that_never_comes_does_not_live_on_those_who_follow() {
        let now = Instant::now();
        let mut fleet = fleet_of_one(now, full_report(10.0, 0, 0));
        fleet.place(now, |_| true);
        for second in 1..=20_u32 {
            fleet.place(now + seconds(f64::from(second) - 0.5), |_| true);
            fleet.report(&0, now + seconds(f64::from(second)), full_report(10.0, second, second.into()));
        }
        assert_eq!(fleet.in_flight(&0, now + seconds(20.0)), 0);
    }

    #[test]
    fn a_client_that_came_counts_until_the_load_shows_it() {
        let now = Instant::now();
        let mut fleet = fleet_of_one(now, full_report(10.0, 5, 5));
        fleet.place(now, |_| true);
        assert_eq!((fleet.effective_load(&0, now), fleet.in_flight(&0, now)), (Some(12.0), 1));
        for (after, load, expected) in [(1.0, 10.0, 11.75), (4.0, 11.0, 12.0), (8.0, 12.0, 12.0)] {
            let later = now + seconds(after);
            fleet.report(&0, later, full_report(load, 6, 6));
            assert_eq!(fleet.in_flight(&0, later), 0);
            assert_near(fleet.effective_load(&0, later), expected, 0.3);
        }
    }

    #[test]
    fn a_load_alone_shows_a_placement_after_a_while() {
        let now = Instant::now();
        let mut fleet = fleet_of_one(now, load_only(10.0));
        fleet.place(now, |_| true);
        for (after, expected) in [(0.0, 12.0), (4.0, 11.0), (8.0, 10.0)] {
            fleet.report(&0, now + seconds(after), load_only(10.0));
            assert_near(fleet.effective_load(&0, now + seconds(after)), expected, 0.1);
        }
    }

    #[test]
    fn those_who_left_are_taken_off_the_load_that_still_shows_them() {
        let now = Instant::now();
        let mut fleet = fleet_of_one(now, full_report(40.0, 20, 20));
        let later = now + seconds(1.0);
        fleet.report(&0, later, full_report(40.0, 10, 20));
        assert_near(fleet.effective_load(&0, later), 22.0, 1.0);
        let settled = now + seconds(8.0);
        fleet.report(&0, settled, full_report(21.0, 10, 20));
        assert_eq!(fleet.effective_load(&0, settled), Some(21.0));
    }

    #[test]
    fn a_repeated_or_late_report_changes_nothing() {
        let now = Instant::now();
        let mut fleet = fleet_of_one(now, full_report(10.0, 5, 5));
        fleet.place(now, |_| true);
        fleet.place(now, |_| true);
        let report = full_report(10.0, 6, 6);
        let later = now + seconds(1.0);
        fleet.report(&0, later, report);
        let before = fleet.effective_load(&0, later).unwrap();
        for (at, repeated_or_late) in [(later, report), (now, full_report(70.0, 0, 0))] {
            fleet.report(&0, at, repeated_or_late);
            assert_eq!(fleet.in_flight(&0, later), 1);
            assert_near(fleet.effective_load(&0, later), before, 0.01);
        }
    }

    #[test]
    fn a_server_that_began_anew_keeps_what_is_on_its_way() {
        let now = Instant::now();
        let mut fleet = fleet_of_one(now, full_report(60.0, 30, 500));
        fleet.place(now, |_| true);
        fleet.lose(&0);
        let later = now + seconds(3.0);
        fleet.report(&0, later, full_report(1.0, 0, 0));
        assert_eq!(fleet.in_flight(&0, later), 1);
        assert_near(fleet.effective_load(&0, later), 3.0, 0.1);
        fleet.report(&0, later + seconds(1.0), full_report(1.0, 1, 1));
        assert_eq!(fleet.in_flight(&0, later + seconds(1.0)), 0);
    }

    /// Reports once a second, while the number of clients moves between 0 and `most`.
    fn teach(fleet: &mut Fleet<u32>, id: u32, start: Instant, cost: f64, most: u32) {
        let mut arrivals = 0;
        for second in 0..600_u32 {
            // Each client stays long enough for the mean load to show it.
            let step = second / 20;
            let present = if (step / most).is_multiple_of(2) { step % most } else { most - step % most };
            if second.is_multiple_of(20) {
                arrivals += 1;
            }
            let noise = if second.is_multiple_of(2) { 1.0 } else { -1.0 };
            let load = (5.0 + cost * f64::from(present) + noise).min(100.0);
            fleet.report(&id, start + seconds(f64::from(second)), full_report(load, present, arrivals));
        }
    }

    #[test]
    fn a_load_alone_teaches_the_cost_of_clients_who_leave_as_others_come() {
        let start = Instant::now();
        for cost in [1.0, 2.0, 4.0, 8.0] {
            let mut fleet = fleet_of_one(start, load_only(3.0));
            let (mut came, mut drawn) = (Vec::new(), 1_u32);
            for second in 1..600 {
                let (time, now) = (f64::from(second), start + seconds(f64::from(second)));
                // One in eight seconds, on average. Each stays a minute, and the load is a mean of five seconds.
                drawn = drawn.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                if drawn >> 29 == 0 && fleet.place(now, |_| true).is_some() {
                    came.push(time);
                }
                let shown = |at: &f64| ((time - at - 2.0).min(5.0) - (time - at - 62.0).max(0.0)).max(0.0) / 5.0;
                let load = 3.0 + cost * came.iter().map(shown).sum::<f64>();
                fleet.report(&0, now, load_only(load));
            }
            assert_near(fleet.learned_cost(&0), cost, 0.25 * cost);
        }
    }

    #[test]
    fn the_cost_of_a_client_is_learned_for_each_server() {
        let start = Instant::now();
        let costs = [0.5, 1.0, 2.0, 4.0, 8.0];
        let mut fleet = Fleet::new(Policy::default());
        for (id, cost) in (0..).zip(costs) {
            fleet.add(id);
            teach(&mut fleet, id, start, cost, 10);
        }
        for (id, cost) in (0..).zip(costs) {
            assert_near(fleet.learned_cost(&id), cost, 0.2 * cost);
        }
    }

    #[test]
    fn a_new_server_is_expected_to_be_like_the_others() {
        let start = Instant::now();
        let mut fleet = Fleet::new(Policy::default());
        for id in 0..4 {
            fleet.add(id);
            teach(&mut fleet, id, start, 6.0, 10);
        }
        fleet.add(9);
        assert_eq!(fleet.learned_cost(&9), Some(2.0));
        fleet.report(&9, start, full_report(0.0, 0, 0));
        assert_near(fleet.learned_cost(&9), 6.0, 0.6);
        // Those that look alike are taken as alike, up to how much the mean moved between their last reports.
        assert_near(fleet.learned_cost(&1), 6.0, 0.6);
    }

    #[test]
    fn an_absurd_policy_does_no_harm() {
        for initial_cost in [0.0, -3.0, f64::NAN, f64::INFINITY] {
            let start = Instant::now();
            let mut fleet = Fleet::new(policy(initial_cost));
            for id in 0..3 {
                fleet.add(id);
                teach(&mut fleet, id, start, 2.0, 10);
            }
            assert_near(fleet.learned_cost(&0), 2.0, 0.4);
        }
    }

    #[test]
    fn a_full_machine_does_not_teach_that_clients_are_cheap() {
        let start = Instant::now();
        let mut fleet = fleet_of_one(start, full_report(100.0, 20, 20));
        let mut last = start;
        for second in 1..300_u32 {
            last = start + seconds(f64::from(second));
            fleet.report(&0, last, full_report(100.0, 20 + second, u64::from(20 + second)));
        }
        assert!(fleet.learned_cost(&0).is_some_and(|cost| cost >= 2.0));
        assert!(!fleet.available(last));
    }

    /// Sends so many clients at once; gives back how many each server got.
    fn burst(fleet: &mut Fleet<u32>, now: Instant, clients: usize, servers: u32) -> Vec<usize> {
        for _ in 0..clients {
            fleet.place(now, |_| true);
        }
        (0..servers).map(|id| fleet.in_flight(&id, now)).collect()
    }

    proptest! {
        #[test]
        fn a_burst_over_equal_servers_differs_by_one(servers in 1..60_u32, load in 0.0..50.0, clients in 0..1500_usize) {
            let now = Instant::now();
            let mut fleet = Fleet::new(policy(0.25));
            for id in 0..servers {
                fleet.add(id);
                fleet.report(&id, now, full_report(load, 3, 3));
            }
            let placed = burst(&mut fleet, now, clients, servers);
            let (least, most) = (placed.iter().min().copied(), placed.iter().max().copied());
            prop_assert!(most.unwrap_or(0) - least.unwrap_or(0) <= 1, "{placed:?}");
        }

        #[test]
        fn a_burst_over_unequal_servers_ends_level(loads in prop::collection::vec(0.0..94.0, 1..40), clients in 0..2000_usize) {
            let now = Instant::now();
            let mut fleet = Fleet::new(Policy::default());
            let servers = u32::try_from(loads.len()).unwrap();
            for (id, load) in (0..).zip(&loads) {
                fleet.add(id);
                fleet.report(&id, now, load_only(*load));
            }
            let placed = burst(&mut fleet, now, clients, servers);
            let level = |id| fleet.effective_load(&id, now).unwrap();
            let lowest = (0..servers).map(level).fold(f64::INFINITY, f64::min);
            for (id, placed) in (0..).zip(placed) {
                // Whoever got a client is at most one client above the least loaded.
                prop_assert!(placed == 0 || level(id) <= lowest + 2.0 + 1e-9);
                prop_assert!(level(id) < 95.0 + 2.0);
            }
            prop_assert_eq!(fleet.available(now), lowest < 95.0);
        }

        #[test]
        fn whatever_is_reported_all_numbers_stay_sane(
            steps in prop::collection::vec(
                (0..3_u32, 0.0..20.0, prop::option::of((0..500_u32, 0..50_u32, any::<u64>(), any::<bool>())),
                 prop_oneof![4 => 0.0..110.0, 1 => any::<f64>()], 0..6_u8),
                1..200,
            )
        ) {
            let mut now = Instant::now();
            let mut fleet = Fleet::new(Policy::default());
            (0..3).for_each(|id| fleet.add(id));
            for (id, pause, instances, load, action) in steps {
                now += seconds(pause);
                let instances = instances.map(|(present, places, arrivals, accepting)| {
                    Instances { present, places, arrivals: arrivals >> (arrivals % 64), accepting }
                });
                match action {
                    0 => fleet.lose(&id),
                    1 => { fleet.remove(&id); fleet.add(id); }
                    2 => prop_assert_eq!(fleet.available(now), fleet.place(now, |_| true).is_some()),
                    _ => fleet.report(&id, now, Report { load, instances }),
                }
                for id in 0..3 {
                    let cost = fleet.learned_cost(&id).unwrap();
                    prop_assert!((0.25..=50.0).contains(&cost), "cost {}", cost);
                    prop_assert!(fleet.effective_load(&id, now).is_none_or(|load| load >= 0.0));
                }
            }
        }
    }
}
