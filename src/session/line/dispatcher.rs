//! Who gets the next slot of which server.
//!
//! Servers that reserve slots are told who waits, and offer slots. On servers that only report, a client whose turn
//! comes takes what the report shows.

use std::collections::{HashMap, HashSet};
use std::hash::Hash;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::link::{LISTED, Link};
use super::rate::{Rate, estimate};
use super::ticket::Ticket;
use super::waiting_line::{Entry, Group, Place, Progress, WaitingClient, WaitingLine};
use crate::session::placement::{LoadBalancer, ReadyWorlds};
use crate::shared::domain::{Admission, Hello, Offers, Pass, ProjectUrl, Wishes};

/// A moment, by both clocks.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    /// For intervals.
    pub instant: Instant,
    /// In milliseconds since 1970, for what outlives the server.
    pub unix: u64,
}

/// A client's turn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Turn<Server> {
    /// The server that takes it.
    pub server: Server,
    /// Its world.
    pub world: ProjectUrl,
    /// Its pass, if the server has reserved a slot.
    pub pass: Option<Pass>,
    /// How long it has waited.
    pub waited: Duration,
}

/// What has become of a client that asked for a slot.
#[derive(Debug, PartialEq, Eq)]
pub enum Entered<Server, Client> {
    /// It has a place in the line, which another connection may have lost.
    Waits(Place, Option<Client>),
    /// It comes back for the turn that it has had a moment ago.
    Again(Turn<Server>),
}

/// What follows from a change.
#[derive(Debug)]
pub struct Served<Server, Client> {
    /// The clients whose turn it is.
    pub turns: Vec<(Client, Turn<Server>)>,
    /// What simulation servers must be told.
    pub wishes: Vec<(Server, Wishes)>,
}

/// A turn that was given.
#[derive(Debug)]
struct PastTurn<Server> {
    turn: Turn<Server>,
    /// Until when its pass is valid.
    until: Instant,
    /// Whether the server has seen its client with it.
    is_used: bool,
    /// Until when its ticket must be known.
    kept: Instant,
}

/// The worlds of one repository that wait.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WaitingFor {
    /// The repository.
    pub repository: String,
    /// Number of clients.
    pub waiting: u32,
    /// How long the first of them has waited.
    pub longest: Duration,
}

/// What is known of the line.
#[derive(Debug, Clone, Default)]
pub struct LineStatus {
    /// Number of clients that wait.
    pub waiting: usize,
    /// What they wait for, those that have waited longest first.
    pub worlds: Vec<WaitingFor>,
}

impl LineStatus {
    /// How long the first client has waited.
    pub fn longest(&self) -> Duration {
        self.worlds.first().map_or(Duration::ZERO, |first| first.longest)
    }
}

/// The line, and the servers whose slots it gets.
#[derive(Debug)]
pub struct Dispatcher<Server, Client> {
    line: WaitingLine<Client>,
    links: HashMap<Server, Link>,
    /// The rates at which slots of servers become free, each with the number of slots that it has counted.
    rates: HashMap<Server, (u64, Rate)>,
    turns: HashMap<u64, PastTurn<Server>>,
}

/// How long a turn without a reservation can be resumed.
const TURN: Duration = Duration::from_secs(10);
/// How long a used ticket is known: longer than any ticket is valid.
const KEPT: Duration = Duration::from_secs(40);
/// Most repositories for which it is worked out who competes with whom. Beyond, each competes with all.
const MAX_GROUPS: usize = 64;

impl<Server, Client> Default for Dispatcher<Server, Client> {
    fn default() -> Self {
        Self {
            line: WaitingLine::default(),
            links: HashMap::new(),
            rates: HashMap::new(),
            turns: HashMap::new(),
        }
    }
}

impl<Server: Clone + Eq + Hash, Client: Clone> Dispatcher<Server, Client> {
    /// A client asks for a slot. With a valid ticket it has the place in that; `number` is that of a new ticket. `is_up`
    /// is whether a server answers.
    ///
    /// A ticket whose turn has come is not valid any more, unless the server is gone that had to take its client.
    pub fn enter(
        &mut self,
        ticket: Option<Ticket>,
        entry: Entry<Client>,
        number: u64,
        is_up: impl Fn(&Server) -> bool,
        now: Moment,
    ) -> Entered<Server, Client> {
        let mut place = Place {
            since: now.unix,
            number,
        };
        if let Some(ticket) = ticket {
            match self.turns.get(&ticket.place.number) {
                None => place = ticket.place,
                Some(past) if past.is_used => {}
                Some(past) if !self.still_takes(&past.turn, is_up) => {
                    place = ticket.place;
                    self.turns.remove(&place.number);
                }
                Some(past) if now.instant < past.until => return Entered::Again(past.turn.clone()),
                Some(_) => {}
            }
        }
        let (place, displaced) = self.line.enter(place, entry, now.instant);
        Entered::Waits(place, displaced)
    }

    /// Whether the server of a turn is the one that it was.
    fn still_takes(&self, turn: &Turn<Server>, is_up: impl Fn(&Server) -> bool) -> bool {
        match turn.pass {
            None => is_up(&turn.server),
            Some(pass) => self
                .links
                .get(&turn.server)
                .is_some_and(|link| link.server == pass.server),
        }
    }

    /// The client of a connection leaves its place.
    pub fn leave(&mut self, place: Place, connection: u64) {
        self.line.leave(place, connection);
    }

    /// A server reserves slots from now on.
    pub fn link(&mut self, server: Server, hello: &Hello) {
        self.links.insert(server, Link::new(hello));
    }

    /// A server reserves no more slots; those that it has reserved stay.
    pub fn unlink(&mut self, server: &Server) {
        self.links.remove(server);
    }

    /// Keeps what is known of these servers only.
    pub fn retain(&mut self, is_known: impl Fn(&Server) -> bool) {
        self.links.retain(|server, _| is_known(server));
        self.rates.retain(|server, _| is_known(server));
    }

    /// A server reports how many slots have become free since its start.
    pub fn count_freed(&mut self, server: &Server, freed: u64, now: Instant) {
        let fresh = || (freed, Rate::new(now));
        let (counted, rate) = self.rates.entry(server.clone()).or_insert_with(fresh);
        // A server that was started again counts from zero.
        let new = freed.checked_sub(*counted).unwrap_or(freed);
        *counted = freed;
        rate.count(now, u32::try_from(new).unwrap_or(u32::MAX));
    }

    /// A server has reserved slots. Those of clients that are gone go back with the next wishes.
    pub fn offered(
        &mut self,
        server: &Server,
        offers: &Offers,
        fleet: &mut LoadBalancer<Server>,
        now: Moment,
    ) -> Vec<(Client, Turn<Server>)> {
        let Some(link) = self.links.get_mut(server) else {
            return Vec::new();
        };
        link.answered(offers, now.unix);
        if offers.free == 0 {
            fleet.fill(server);
        }
        let run = link.server;
        let valid = link.pass;
        for past in self.turns.values_mut().filter(|_| !offers.used.is_empty()) {
            let reservation = past
                .turn
                .pass
                .filter(|pass| pass.server == run)
                .map(|pass| pass.reservation);
            past.is_used |= reservation.is_some_and(|reservation| offers.used.contains(&reservation));
        }
        let mut turns = Vec::new();
        for offer in &offers.offers {
            let pass = Pass {
                server: run,
                reservation: offer.reservation,
            };
            if let Some(place) = self.line.place_of(offer.ticket) {
                fleet.place(server, now.instant);
                turns.extend(self.turn(place, server, Some((pass, valid)), now));
            } else if let Some(link) = self.links.get_mut(server) {
                link.back.push(offer.reservation);
            }
        }
        turns
    }

    /// Gives turns on servers that only report, and will not reserve slots soon, and says what the others must be told: of these, only one if only its
    /// state has changed.
    pub fn serve(
        &mut self,
        fleet: &mut LoadBalancer<Server>,
        admission: impl Fn(&Server, &ProjectUrl, f64) -> Option<Admission>,
        will_reserve: impl Fn(&Server) -> bool,
        ready: &ReadyWorlds<Server>,
        only: Option<&Server>,
        now: Moment,
    ) -> Served<Server, Client> {
        self.turns.retain(|_, past| now.instant < past.kept);
        let Shares {
            mut assigned,
            starved,
            plain,
        } = self.share(fleet, &admission, &will_reserve, ready, now);
        let mut turns = Vec::new();
        for (place, server) in plain {
            turns.extend(self.turn(place, &server, None, now));
        }
        let line = &self.line;
        let mut wishes = Vec::new();
        for (server, link) in &mut self.links {
            let room = assigned.remove(server);
            if room.is_none() && only.is_some_and(|only| only != server) {
                continue;
            }
            let mut first = room.unwrap_or_default();
            let mut all = first.len();
            if !starved.is_empty() && fleet.would_take(server) {
                let load = fleet.effective_load(server);
                let accepts = |world: &ProjectUrl| load.is_some_and(|load| admission(server, world, load).is_some());
                let taken: HashSet<&str> = starved
                    .iter()
                    .filter(|group| accepts(&group.world))
                    .map(|group| group.repository())
                    .collect();
                let waiting = line.iter().filter(|(_, one)| taken.contains(one.group.repository()));
                first.extend(
                    waiting
                        .map(|(place, _)| *place)
                        .take(if taken.is_empty() { 0 } else { LISTED }),
                );
                first.sort_unstable();
                first.dedup();
                first.truncate(LISTED);
                let counted = line.groups().filter(|(group, _)| taken.contains(group.repository()));
                all = first.len().max(counted.map(|(_, count)| count as usize).sum());
            }
            let all = u32::try_from(all).unwrap_or(u32::MAX);
            let waits = |place: &Place| line.place_of(place.number).is_some();
            let told = link.wishes(first, all, waits, |place| line.wish(*place, now.unix));
            wishes.extend(told.map(|told| (server.clone(), told)));
        }
        Served { turns, wishes }
    }

    /// Shares the room of the fleet out, in the order of the line; servers that keep a client's world ready come first. The room that clients of reserving servers get is
    /// counted only once they have offers.
    fn share(
        &self,
        fleet: &mut LoadBalancer<Server>,
        admission: &impl Fn(&Server, &ProjectUrl, f64) -> Option<Admission>,
        will_reserve: &impl Fn(&Server) -> bool,
        ready: &ReadyWorlds<Server>,
        now: Moment,
    ) -> Shares<Server> {
        let mut shares = Shares {
            assigned: HashMap::new(),
            starved: Vec::new(),
            plain: Vec::new(),
        };
        // Until a server has answered, it may offer slots to those that it was told of.
        let mut pending = HashSet::new();
        let mut placed = Vec::new();
        for (server, link) in &self.links {
            for place in link.unanswered() {
                if self.line.place_of(place.number).is_some() && fleet.has_room(server) && pending.insert(*place) {
                    fleet.place(server, now.instant);
                    placed.push(server.clone());
                }
            }
        }
        let groups = self.line.groups().count();
        // The simulations that are kept ready and go to those ahead.
        let mut used: HashMap<(Server, &ProjectUrl), usize> = HashMap::new();
        let mut starved: HashSet<*const Group> = HashSet::new();
        for (place, waiting) in self.line.iter() {
            if starved.len() == groups {
                break;
            }
            if pending.contains(place) || starved.contains(&Arc::as_ptr(&waiting.group)) {
                continue;
            }
            let terms = |server: &Server, load| {
                let is_ready = self.links.contains_key(server) || !will_reserve(server);
                admission(server, &waiting.group.world, load).filter(|_| is_ready)
            };
            let world = &waiting.world;
            let of_ready = |server: &Server, load| {
                let gone = used.get(&(server.clone(), world)).copied().unwrap_or_default();
                terms(server, load).filter(|_| ready.left(server, world) > gone)
            };
            let ready_one = ready
                .has(world)
                .then(|| fleet.pick_admitted(now.instant, true, of_ready))
                .flatten();
            if let Some(server) = &ready_one {
                *used.entry((server.clone(), world)).or_default() += 1;
            }
            match ready_one.or_else(|| fleet.pick_admitted(now.instant, true, terms)) {
                None => {
                    starved.insert(Arc::as_ptr(&waiting.group));
                    shares.starved.push(Arc::clone(&waiting.group));
                }
                Some(server) if self.links.contains_key(&server) => {
                    shares.assigned.entry(server.clone()).or_default().push(*place);
                    placed.push(server);
                }
                Some(server) => shares.plain.push((*place, server)),
            }
        }
        for server in placed {
            fleet.withdraw(&server);
        }
        shares
    }

    /// Takes a client out of the line: it is its turn.
    fn turn(
        &mut self,
        place: Place,
        server: &Server,
        pass: Option<(Pass, Duration)>,
        now: Moment,
    ) -> Option<(Client, Turn<Server>)> {
        let waiting = self.line.remove(place)?;
        let valid = pass.map_or(TURN, |(_, valid)| valid);
        let turn = Turn {
            server: server.clone(),
            world: waiting.world,
            pass: pass.map(|(pass, _)| pass),
            waited: Duration::from_millis(now.unix.saturating_sub(place.since)),
        };
        let given = PastTurn {
            turn: turn.clone(),
            until: now.instant + valid,
            is_used: false,
            kept: now.instant + valid.max(KEPT),
        };
        self.turns.insert(place.number, given);
        Some((waiting.client, turn))
    }

    /// Whether the free slots of a server belong to the line: somebody waits for a world that it takes at its load, in
    /// percent.
    pub fn claims(
        &self,
        server: &Server,
        load: f64,
        admission: impl Fn(&Server, &ProjectUrl, f64) -> Option<Admission>,
    ) -> bool {
        self.line
            .groups()
            .any(|(group, _)| admission(server, &group.world, load).is_some())
    }

    /// Whether nobody waits.
    pub fn is_empty(&self) -> bool {
        self.line.len() == 0
    }

    /// All who wait, in order.
    pub fn waiting(&self) -> impl Iterator<Item = WaitingClient<'_>> {
        self.line.clients()
    }

    /// What is known of the line at this time, in milliseconds since 1970.
    pub fn status(&self, now: u64) -> LineStatus {
        let mut found: Vec<WaitingFor> = Vec::new();
        let mut seen = HashMap::new();
        for (place, waiting) in self.line.iter() {
            let group = waiting.group.repository();
            let index = *seen.entry(group).or_insert(found.len());
            if index == found.len() {
                found.push(WaitingFor {
                    repository: waiting.group.world.repository(),
                    waiting: 0,
                    longest: Duration::from_millis(now.saturating_sub(place.since)),
                });
            }
            if let Some(one) = found.get_mut(index) {
                one.waiting += 1;
            }
        }
        LineStatus {
            waiting: self.line.len(),
            worlds: found,
        }
    }

    /// The clients whose tickets must be sent again.
    pub fn renewals(&mut self, now: Instant) -> Vec<(Client, Place)> {
        self.line.renewals(now, Ticket::RENEWAL)
    }

    /// How a client stands that has just come, if it waits.
    pub fn first_news(
        &mut self,
        place: Place,
        servers: &[Server],
        accepts: impl Fn(&Server, &ProjectUrl) -> bool,
        now: Instant,
    ) -> Option<Progress> {
        self.standings(servers, accepts, now, |line, progress| {
            line.first_news(place, now, progress)
        })
    }

    /// For each client the progress that it has to hear now, if any.
    pub fn news(
        &mut self,
        servers: &[Server],
        accepts: impl Fn(&Server, &ProjectUrl) -> bool,
        now: Instant,
    ) -> Vec<(Client, Progress)> {
        self.standings(servers, accepts, now, |line, progress| line.news(now, progress))
    }

    /// Calls `tell` with how clients stand, which it must ask in the order of the line.
    fn standings<News>(
        &mut self,
        servers: &[Server],
        accepts: impl Fn(&Server, &ProjectUrl) -> bool,
        now: Instant,
        tell: impl FnOnce(&mut WaitingLine<Client>, &mut dyn FnMut(&Place, &Arc<Group>) -> Progress) -> News,
    ) -> News {
        let classes = Classes::new(&self.line, servers, accepts);
        let queue_of = |server: &Server| {
            self.links
                .get(server)
                .map(|link| link.queue.as_slice())
                .unwrap_or_default()
        };
        // For each class: those ahead so far, those who wait at the doors of its servers, and the rates of these.
        let mut ahead = vec![0_u32; classes.sets.len()];
        let mut queues = Vec::new();
        let mut rates = Vec::new();
        for set in &classes.sets {
            let its_servers = || {
                servers
                    .iter()
                    .zip(set)
                    .filter(|(_, accepts)| **accepts)
                    .map(|(server, _)| server)
            };
            let mut queue: Vec<u64> = its_servers().flat_map(queue_of).copied().collect();
            queue.sort_unstable();
            queues.push(queue);
            let mut of_class = Vec::new();
            for server in its_servers() {
                of_class.extend(self.rates.get_mut(server).map(|(_, rate)| rate.freed(now)));
            }
            rates.push(of_class);
        }
        tell(&mut self.line, &mut |place, group| {
            let class = classes.of(group);
            let competing = classes.competitors.get(class).into_iter().flatten();
            let of_line: u32 = competing.filter_map(|other| ahead.get(*other)).sum();
            let at_doors = queues
                .get(class)
                .map_or(0, |queue| queue.partition_point(|since| *since < place.since));
            let all = of_line.saturating_add(u32::try_from(at_doors).unwrap_or(u32::MAX));
            if let Some(count) = ahead.get_mut(class) {
                *count += 1;
            }
            let rates = rates.get(class).into_iter().flatten().copied();
            Progress {
                ahead: all,
                estimate: estimate(rates, all),
            }
        })
    }
}

/// What a look at the fleet yields.
struct Shares<Server> {
    /// The clients for which reserving servers have room.
    assigned: HashMap<Server, Vec<Place>>,
    /// The groups for which no server has room.
    starved: Vec<Arc<Group>>,
    /// The clients that servers take which only report.
    plain: Vec<(Place, Server)>,
}

/// The groups of a line by the servers that accept them.
struct Classes {
    /// For each class, whether each server accepts it.
    sets: Vec<Vec<bool>>,
    /// For each class, the classes that some server accepts too, and itself.
    competitors: Vec<Vec<usize>>,
    of_group: HashMap<*const Group, usize>,
}

impl Classes {
    fn new<Server, Client: Clone>(
        line: &WaitingLine<Client>,
        servers: &[Server],
        accepts: impl Fn(&Server, &ProjectUrl) -> bool,
    ) -> Self {
        let mut sets: Vec<Vec<bool>> = Vec::new();
        let mut of_group = HashMap::new();
        if line.groups().count() > MAX_GROUPS {
            sets.push(vec![true; servers.len()]);
        } else {
            for (group, _) in line.groups() {
                let set: Vec<bool> = servers.iter().map(|server| accepts(server, &group.world)).collect();
                let class = sets.iter().position(|one| *one == set).unwrap_or(sets.len());
                if class == sets.len() {
                    sets.push(set);
                }
                of_group.insert(Arc::as_ptr(group), class);
            }
        }
        let competes = |one: &[bool], other: &[bool]| one.iter().zip(other).any(|(one, other)| *one && *other);
        let competitors = sets.iter().enumerate().map(|(class, set)| {
            let others = sets.iter().enumerate();
            others
                .filter(|(other, theirs)| *other == class || competes(set, theirs))
                .map(|(other, _)| other)
                .collect()
        });
        Self {
            competitors: competitors.collect(),
            sets,
            of_group,
        }
    }

    fn of(&self, group: &Arc<Group>) -> usize {
        self.of_group.get(&Arc::as_ptr(group)).copied().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;
    use crate::session::placement::PlacementPolicy;
    use crate::shared::domain::{Instances, Load, Offer, ReservationId, ServerReport, ServerRun, Wish};

    const OWNERS: [&str; 3] = ["lab", "school", "club"];

    /// A simulation server as the session server knows it: it answers at once.
    struct FakeServer {
        owners: &'static [usize],
        reserves: bool,
        slots: u32,
        taken: u32,
        freed: u64,
        arrivals: u64,
        wishes: Vec<Wish>,
    }

    /// A fleet, the line before it, and who waits according to the rules.
    struct Fleet {
        dispatcher: Dispatcher<usize, u64>,
        balancer: LoadBalancer<usize>,
        servers: Vec<FakeServer>,
        now: Moment,
        reservations: u64,
        /// The place and the owner of each client that waits.
        waiting: BTreeSet<(Place, usize)>,
        turns: Vec<(u64, usize)>,
    }

    fn accepts(servers: &[FakeServer]) -> impl Fn(&usize, &ProjectUrl) -> bool + use<> {
        let owners: Vec<_> = servers.iter().map(|server| server.owners).collect();
        move |server, world| {
            let owner = &world.repository_segments()[0];
            owners[*server].iter().any(|one| OWNERS[*one] == owner)
        }
    }

    /// A client that wants a world of this owner.
    fn entry(owner: usize, number: u64) -> Entry<u64> {
        let world = format!("https://github.com/{}/a/blob/main/worlds/a.wbt", OWNERS[owner]);
        Entry {
            world: ProjectUrl::parse(&world).unwrap(),
            client: number,
            connection: number,
            address: None,
            user: None,
            label: None,
        }
    }

    impl Fleet {
        fn new(servers: &[(&'static [usize], bool, u32)]) -> Self {
            let server = |&(owners, reserves, slots)| FakeServer {
                owners,
                reserves,
                slots,
                taken: slots,
                freed: 0,
                arrivals: 0,
                wishes: Vec::new(),
            };
            let mut fleet = Self {
                dispatcher: Dispatcher::default(),
                balancer: LoadBalancer::new(PlacementPolicy {
                    threshold: 1000.0,
                    ..PlacementPolicy::default()
                }),
                servers: servers.iter().map(server).collect(),
                now: Moment {
                    instant: Instant::now(),
                    unix: 1_000_000,
                },
                reservations: 0,
                waiting: BTreeSet::new(),
                turns: Vec::new(),
            };
            for server in 0..servers.len() {
                fleet.balancer.add(server);
                if fleet.servers[server].reserves {
                    let hello = Hello {
                        challenge: 0,
                        server: ServerRun(server as u64),
                        pass: 10.0,
                        keeps_ready: true,
                        roster: false,
                    };
                    fleet.dispatcher.link(server, &hello);
                }
            }
            fleet.report();
            fleet
        }

        fn pass_time(&mut self, time: Duration) {
            self.now.instant += time;
            self.now.unix += u64::try_from(time.as_millis()).unwrap();
        }

        /// The session server probes all servers.
        fn report(&mut self) {
            for (id, server) in self.servers.iter().enumerate() {
                let instances = Instances {
                    running: server.taken,
                    slots: server.slots,
                    freed: server.freed,
                    arrivals: server.arrivals,
                    ..Instances::default()
                };
                let report = ServerReport {
                    instances: Some(instances),
                    ..ServerReport::load_only(Load::ZERO)
                };
                self.balancer.report(&id, self.now.instant, &report, true);
                self.dispatcher.count_freed(&id, server.freed, self.now.instant);
            }
        }

        fn enter(&mut self, owner: usize, ticket: Option<Ticket>, number: u64) -> Entered<usize, u64> {
            let entered = self
                .dispatcher
                .enter(ticket, entry(owner, number), number, |_| true, self.now);
            if let Entered::Waits(place, _) = entered {
                self.waiting.insert((place, owner));
            }
            self.serve();
            entered
        }

        /// Exchanges messages until nothing happens any more.
        fn serve(&mut self) {
            loop {
                let accepts = accepts(&self.servers);
                let admission =
                    |server: &usize, world: &ProjectUrl, _| accepts(server, world).then_some(Admission::Dedicated);
                let Served { turns, wishes } = self.dispatcher.serve(
                    &mut self.balancer,
                    admission,
                    |_| false,
                    &ReadyWorlds::default(),
                    None,
                    self.now,
                );
                if turns.is_empty() && wishes.is_empty() {
                    return;
                }
                for (_, turn) in &turns {
                    assert!(!self.servers[turn.server].reserves && turn.pass.is_none());
                }
                self.take(turns);
                for (id, wishes) in wishes {
                    let number = wishes.number;
                    let back = u32::try_from(wishes.back.len()).unwrap();
                    self.servers[id].wishes = wishes.first;
                    self.servers[id].taken -= back;
                    self.offer(id, number);
                }
            }
        }

        /// The server offers its free slots.
        fn offer(&mut self, id: usize, number: u64) {
            let server = &mut self.servers[id];
            let mut offers = Vec::new();
            while server.taken < server.slots && !server.wishes.is_empty() {
                self.reservations += 1;
                server.taken += 1;
                offers.push(Offer {
                    ticket: server.wishes.remove(0).ticket,
                    reservation: ReservationId(self.reservations),
                });
            }
            let offers = Offers {
                number,
                offers,
                free: server.slots - server.taken,
                ..Offers::default()
            };
            // The slots of turns are counted above.
            let turns = self.dispatcher.offered(&id, &offers, &mut self.balancer, self.now);
            for (_, turn) in &turns {
                self.servers[turn.server].taken -= 1;
            }
            self.take(turns);
        }

        fn take(&mut self, turns: Vec<(u64, Turn<usize>)>) {
            for (client, turn) in turns {
                let server = &mut self.servers[turn.server];
                server.taken += 1;
                server.arrivals += 1;
                assert!(server.taken <= server.slots, "a slot is given twice");
                let may_take = |(_, owner): &&(Place, usize)| server.owners.contains(owner);
                let first = *self.waiting.iter().find(may_take).unwrap();
                // A number is a client.
                assert_eq!(first.0.number, client, "another one was first");
                self.waiting.remove(&first);
                self.turns.push((client, turn.server));
            }
        }

        fn leave(&mut self, number: u64) {
            let Some(&(place, owner)) = self.waiting.iter().find(|(place, _)| place.number == number) else {
                return;
            };
            self.dispatcher.leave(place, number);
            self.waiting.remove(&(place, owner));
            self.serve();
        }

        fn free(&mut self, id: usize) {
            let server = &mut self.servers[id];
            if server.taken == 0 {
                return;
            }
            server.taken -= 1;
            server.freed += 1;
            if server.reserves {
                // It offers the slot without being asked again.
                self.offer(id, u64::MAX);
            } else {
                self.report();
            }
            self.serve();
        }

        /// No slot is free that somebody could use.
        fn assert_not_idle(&self) {
            for server in &self.servers {
                let could_use = self.waiting.iter().any(|(_, owner)| server.owners.contains(owner));
                assert!(server.taken == server.slots || !could_use);
            }
        }
    }

    #[derive(Debug, Clone)]
    enum Step {
        Enter(usize),
        Leave(usize),
        ComeBack(usize),
        Free(usize),
        Report,
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            4 => (0..3_usize).prop_map(Step::Enter),
            1 => (0..60_usize).prop_map(Step::Leave),
            1 => (0..60_usize).prop_map(Step::ComeBack),
            4 => (0..4_usize).prop_map(Step::Free),
            1 => Just(Step::Report),
        ]
    }

    proptest! {
        #[test]
        fn slots_go_to_the_first_who_can_use_them_and_none_is_idle(steps in prop::collection::vec(step(), 1..120)) {
            let mut fleet = Fleet::new(&[(&[0, 1], true, 3), (&[0], true, 1), (&[1, 2], true, 2), (&[0, 1, 2], false, 2)]);
            let mut clients: Vec<(Place, usize)> = Vec::new();
            for (number, step) in (1..).zip(steps) {
                fleet.pass_time(Duration::from_millis(10));
                match step {
                    Step::Enter(owner) => {
                        if let Entered::Waits(place, _) = fleet.enter(owner, None, number) {
                            clients.push((place, owner));
                        }
                    }
                    Step::Leave(client) => if let Some((place, _)) = clients.get(client) {
                        fleet.leave(place.number);
                    },
                    Step::ComeBack(client) => if let Some(&(place, owner)) = clients.get(client) {
                        let had_turn = fleet.turns.iter().any(|(one, _)| *one == place.number);
                        fleet.leave(place.number);
                        let sent = fleet.now.unix;
                        let entered = fleet.enter(owner, Some(Ticket { place, sent }), place.number);
                        match entered {
                            Entered::Waits(again, _) => prop_assert!(!had_turn && again == place),
                            Entered::Again(_) => prop_assert!(had_turn),
                        }
                    },
                    Step::Free(server) => fleet.free(server),
                    Step::Report => fleet.report(),
                }
                fleet.serve();
                fleet.assert_not_idle();
            }
        }
    }

    #[test]
    fn a_world_that_few_servers_accept_blocks_nobody_behind_it() {
        let mut fleet = Fleet::new(&[(&[0], true, 1), (&[1], true, 1)]);
        fleet.enter(0, None, 1);
        fleet.enter(1, None, 2);
        fleet.free(1);
        assert_eq!(fleet.turns, [(2, 1)]);
    }

    #[test]
    fn a_position_counts_those_who_compete() {
        let mut fleet = Fleet::new(&[(&[0], true, 1), (&[0, 1], true, 1), (&[2], true, 1)]);
        for (number, owner) in [(1, 0), (2, 2), (3, 1), (4, 0), (5, 2)] {
            fleet.pass_time(Duration::from_millis(1));
            fleet.enter(owner, None, number);
        }
        let accepts = accepts(&fleet.servers);
        let news = fleet.dispatcher.news(&[0, 1, 2], &accepts, fleet.now.instant);
        let ahead: Vec<_> = news
            .iter()
            .map(|(client, progress)| (*client, progress.ahead))
            .collect();
        assert_eq!(ahead, [(1, 0), (2, 0), (3, 1), (4, 2), (5, 1)]);
        assert!(
            news.iter().all(|(_, progress)| progress.estimate.is_none()),
            "without a basis"
        );
    }

    #[test]
    fn an_estimate_follows_from_the_slots_that_became_free() {
        let mut fleet = Fleet::new(&[(&[0], true, 30), (&[1], true, 30)]);
        for second in 0..12 {
            fleet.pass_time(Duration::from_secs(10));
            fleet.report();
            if second % 2 == 0 {
                fleet.free(0);
                fleet.servers[0].taken += 1;
            }
        }
        fleet.report();
        fleet.enter(0, None, 1);
        fleet.enter(1, None, 2);
        let accepts = accepts(&fleet.servers);
        let news = fleet.dispatcher.news(&[0, 1], &accepts, fleet.now.instant);
        let estimates: Vec<_> = news.iter().map(|(_, progress)| progress.estimate).collect();
        assert_eq!(estimates, [Some(20), None], "six slots in 110 seconds, and none");
    }

    #[test]
    fn a_turn_is_resumed_while_its_pass_holds_and_its_ticket_is_used_once() {
        let mut fleet = Fleet::new(&[(&[0], true, 1)]);
        let Entered::Waits(place, None) = fleet.enter(0, None, 1) else {
            panic!()
        };
        fleet.free(0);
        let ticket = Some(Ticket {
            place,
            sent: fleet.now.unix,
        });
        let Entered::Again(turn) = fleet.enter(0, ticket, 2) else {
            panic!()
        };
        assert!(turn.server == 0 && turn.pass.is_some());
        fleet.pass_time(Duration::from_secs(11));
        let Entered::Waits(again, None) = fleet.enter(0, ticket, 3) else {
            panic!()
        };
        assert_eq!(
            again,
            Place {
                since: fleet.now.unix,
                number: 3
            }
        );
    }

    #[test]
    fn whose_server_is_gone_has_its_place_again_and_whose_pass_is_used_has_not() {
        let mut fleet = Fleet::new(&[(&[0], true, 2)]);
        let Entered::Waits(first, None) = fleet.enter(0, None, 1) else {
            panic!()
        };
        fleet.pass_time(Duration::from_millis(1));
        let Entered::Waits(second, None) = fleet.enter(0, None, 2) else {
            panic!()
        };
        fleet.free(0);
        fleet.free(0);
        let used = Offers {
            number: u64::MAX,
            used: vec![ReservationId(2)],
            ..Offers::default()
        };
        fleet.dispatcher.offered(&0, &used, &mut fleet.balancer, fleet.now);
        fleet.dispatcher.unlink(&0);
        let sent = fleet.now.unix;
        let again = |place| Some(Ticket { place, sent });
        fleet.pass_time(Duration::from_millis(1));
        assert_eq!(fleet.enter(0, again(first), 3), Entered::Waits(first, None));
        let since = fleet.now.unix;
        assert_eq!(
            fleet.enter(0, again(second), 4),
            Entered::Waits(Place { since, number: 4 }, None)
        );
    }

    #[test]
    fn a_server_that_is_full_contrary_to_its_report_keeps_nobody_waiting() {
        let mut fleet = Fleet::new(&[(&[0], true, 5), (&[0], true, 5)]);
        // Both report room; another session server has taken that of the first.
        fleet.servers[0].taken = 0;
        fleet.servers[1].taken = 0;
        fleet.report();
        fleet.servers[0].taken = 5;
        for number in 1..=5 {
            fleet.enter(0, None, number);
        }
        assert_eq!(fleet.turns.iter().filter(|(_, server)| *server == 1).count(), 5);
    }

    #[test]
    fn five_thousand_who_wait_cost_little() {
        let mut fleet = Fleet::new(&[(&[0], true, 10), (&[0, 1], true, 10)]);
        for number in 1..=5_000 {
            fleet.pass_time(Duration::from_millis(1));
            let owner = usize::from(number % 2 == 0);
            fleet
                .dispatcher
                .enter(None, entry(owner, number), number, |_| true, fleet.now);
        }
        let accepts = accepts(&fleet.servers);
        fleet.dispatcher.news(&[0, 1], &accepts, fleet.now.instant);
        let mut sent = 0;
        for _ in 0..60 {
            fleet.pass_time(Duration::from_secs(1));
            let first = *fleet.dispatcher.line.iter().next().unwrap().0;
            fleet.dispatcher.line.remove(first);
            sent += fleet.dispatcher.news(&[0, 1], &accepts, fleet.now.instant).len();
        }
        assert!(sent < 60 * 700, "{sent} messages in a minute");
    }
}
