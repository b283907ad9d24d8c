//! Who gets the next slot of which server.
//!
//! Servers that reserve slots are told who waits, and offer slots. On servers that only report, a client whose turn
//! comes takes what the report shows.

use std::collections::{HashMap, HashSet};
use std::hash::Hash;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::classes::{ClassId, Classes, Doors, Terms};
use super::link::Link;
use super::rate::{Basis, Rate};
use super::ticket::Ticket;
use super::waiting_line::{Entry, LISTED, Place, Position, WaitingClient, WaitingLine};
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
    pub world: Arc<ProjectUrl>,
    /// Its pass, if the server has reserved a slot.
    pub pass: Option<Pass>,
    /// How long it has waited.
    pub waited: Duration,
}

/// What has become of a client that asked for a slot.
#[derive(Debug, PartialEq, Eq)]
pub enum Entered<Server, Client> {
    /// It has a place in the line. These have lost theirs to it.
    Waits(Place, Vec<Client>),
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
    /// When the first of them has come, in milliseconds since 1970.
    pub since: u64,
    /// How long it has waited.
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
    line: WaitingLine<Server, Client>,
    links: HashMap<Server, Link>,
    /// The rates at which slots of servers become free, each with the number of slots that it has counted.
    rates: HashMap<Server, (u64, Rate)>,
    turns: HashMap<u64, PastTurn<Server>>,
    /// Those who have come since it was last told how clients stand.
    newcomers: Vec<Place>,
}

/// How long a turn without a reservation can be resumed.
const TURN: Duration = Duration::from_secs(10);
/// How long a used ticket is known: longer than any ticket is valid.
const KEPT: Duration = Duration::from_secs(Ticket::VALIDITY.as_secs() + 10);

impl<Server, Client> Default for Dispatcher<Server, Client> {
    fn default() -> Self {
        Self {
            line: WaitingLine::default(),
            links: HashMap::new(),
            rates: HashMap::new(),
            turns: HashMap::new(),
            newcomers: Vec::new(),
        }
    }
}

impl<Server: Clone + Eq + Hash, Client: Clone> Dispatcher<Server, Client> {
    /// A client asks for a slot. With a valid ticket it has the place in that; `number` is that of a new ticket. `is_up`
    /// is whether a server answers and does not drain, `terms` on what terms one takes a world by its last report.
    ///
    /// A ticket whose turn has come is not valid any more, except to hear that turn again for the same world, or if the server
    /// is gone that had to take its client, or takes nobody any more.
    pub fn enter(
        &mut self,
        ticket: Option<Ticket>,
        entry: Entry<Client>,
        number: u64,
        is_up: impl Fn(&Server) -> bool,
        terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>,
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
                // A pass is for one world.
                Some(past) if now.instant < past.until && *past.turn.world == entry.world => {
                    return Entered::Again(past.turn.clone());
                }
                Some(_) => {}
            }
        }
        let (place, displaced) = self.line.enter(place, entry, terms, now.instant);
        self.newcomers.push(place);
        Entered::Waits(place, displaced)
    }

    /// Whether the server of a turn takes clients, and is the one that it was.
    fn still_takes(&self, turn: &Turn<Server>, is_up: impl Fn(&Server) -> bool) -> bool {
        let run = self.links.get(&turn.server).map(|link| link.server);
        is_up(&turn.server) && turn.pass.is_none_or(|pass| run == Some(pass.server))
    }

    /// A wait is over.
    pub fn leave(&mut self, wait: u64) {
        self.line.leave(wait);
    }

    /// A server reserves slots from now on.
    pub fn link(&mut self, server: Server, hello: &Hello) {
        self.links.insert(server, Link::new(hello));
    }

    /// A server reserves no more slots; those that it has reserved stay.
    pub fn unlink(&mut self, server: &Server) {
        self.links.remove(server);
    }

    /// The fleet consists of these servers now. `terms` is on what terms one takes a world by its last report.
    pub fn set_servers(&mut self, servers: &[Server], terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>) {
        let known: HashSet<&Server> = servers.iter().collect();
        self.links.retain(|server, _| known.contains(server));
        self.rates.retain(|server, _| known.contains(server));
        self.line.set_servers(servers, terms);
    }

    /// A server takes other worlds now, or on other terms.
    pub fn rules_changed(&mut self, server: &Server, terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>) {
        self.line.rules_changed(server, terms);
    }

    /// Forgets tickets that are not valid any more.
    pub fn forget(&mut self, now: Instant) {
        self.turns.retain(|_, past| now < past.kept);
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
        let used: HashSet<_> = offers.used.iter().collect();
        for past in self.turns.values_mut().filter(|_| !used.is_empty()) {
            let reservation = past
                .turn
                .pass
                .filter(|pass| pass.server == run)
                .map(|pass| pass.reservation);
            past.is_used |= reservation.is_some_and(|reservation| used.contains(&reservation));
        }
        let mut turns = Vec::new();
        for offer in &offers.offers {
            let pass = Pass {
                server: run,
                reservation: offer.reservation,
            };
            // The place may be for another world by now, which this server does not take.
            if let Some(place) = self.line.place_at(server, offer.ticket) {
                fleet.place(server, now.instant);
                turns.extend(self.turn(place, server, Some((pass, valid)), now));
            } else if let Some(link) = self.links.get_mut(server) {
                link.give_back(offer.reservation);
            }
        }
        turns
    }

    /// Gives turns on servers that only report and will not reserve slots soon, and says what the others must be told.
    /// `admission` is on what terms a server takes a world at a load, in percent.
    pub fn serve(
        &mut self,
        fleet: &mut LoadBalancer<Server>,
        admission: impl Fn(&Server, &ProjectUrl, f64) -> Option<Admission>,
        will_reserve: impl Fn(&Server) -> bool,
        ready: &ReadyWorlds<Server>,
        now: Moment,
    ) -> Served<Server, Client> {
        let Shares {
            mut assigned,
            starved,
            plain,
            placed,
        } = self.share(fleet, &admission, &will_reserve, ready, now);
        let mut turns = Vec::new();
        for (place, server) in plain {
            turns.extend(self.turn(place, &server, None, now));
        }
        let line = &self.line;
        let mut wishes = Vec::new();
        // Servers that take the same classes are told of the same clients.
        let mut lists: HashMap<Vec<ClassId>, Vec<Place>> = HashMap::new();
        for (server, link) in self.links.iter_mut().filter(|(_, link)| !link.owes_answer()) {
            let mut first = assigned.remove(server).unwrap_or_default();
            let mut all = first.len();
            // With those it gets now: a slot that becomes free later is for one of the others, as the load falls with it.
            let load = fleet.effective_load(server).filter(|_| fleet.would_take(server));
            let may_come = |class: &&ClassId| {
                let world = line.classes().get(**class).map(|class| &class.world);
                let world_and_load = world.zip(load);
                world_and_load.is_some_and(|(world, load)| admission(server, world, load).is_some())
            };
            let taken: Vec<ClassId> = starved.iter().filter(may_come).copied().collect();
            if !taken.is_empty() {
                let waiting = taken.iter().filter_map(|class| line.classes().get(*class));
                let waiting: usize = waiting.map(|class| class.waiting as usize).sum();
                if link.passed.is_empty() {
                    let list = lists.entry(taken);
                    first.extend(list.or_insert_with_key(|taken| line.told_of(taken, &[], false)).iter());
                } else {
                    // Where room is left, all others have got some.
                    first.extend(line.told_of(&taken, &link.passed, fleet.has_room(server)));
                }
                first.sort_unstable();
                first.dedup();
                first.truncate(LISTED);
                all = first.len().max(waiting);
            }
            let all = u32::try_from(all).unwrap_or(u32::MAX);
            let waits = |place: &Place| line.place_of(place.number).is_some();
            let told = link.wishes(first, all, waits, |place| line.wish(*place, now.unix));
            wishes.extend(told.map(|told| (server.clone(), told)));
        }
        // The room that they get is counted once they have offers.
        for server in placed {
            fleet.withdraw(&server);
        }
        Served { turns, wishes }
    }

    /// Shares the room of the fleet out, in the order of the line; servers that keep a client's world ready come first.
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
            placed: Vec::new(),
        };
        // Until a server has answered, it may offer slots to those that it was told of.
        let mut pending = HashSet::new();
        for (server, link) in &self.links {
            for place in link.unanswered() {
                if self.line.place_of(place.number).is_some() && fleet.has_room(server) && pending.insert(*place) {
                    fleet.place(server, now.instant);
                    shares.placed.push(server.clone());
                }
            }
        }
        let classes = self.line.classes().occupied();
        // Those of which nobody else gets a slot either.
        let mut exhausted = HashSet::new();
        // The simulations that are kept ready and go to those ahead.
        let mut used: HashMap<(Server, &ProjectUrl), usize> = HashMap::new();
        for (place, waiting) in self.line.iter() {
            let class = waiting.group.class.get();
            if exhausted.len() == classes {
                break;
            }
            if exhausted.contains(&class) || pending.contains(place) {
                continue;
            }
            let passes_over = |server: &Server| {
                let link = self.links.get(server);
                link.is_some_and(|link| link.passed.iter().any(|passed| waiting.is_of(passed)))
            };
            let terms = |server: &Server, load| {
                let takes_part = self.links.contains_key(server) || !will_reserve(server);
                admission(server, &waiting.group.world, load).filter(|_| takes_part && !passes_over(server))
            };
            let world: &ProjectUrl = &waiting.world;
            let picked = if ready.has(world) {
                let has_ready = |server: &Server| {
                    let gone = used.get(&(server.clone(), world)).copied().unwrap_or_default();
                    ready.left(server, world) > gone
                };
                let picked = fleet.pick_ready_first(now.instant, true, has_ready, terms);
                if let Some(server) = picked.as_ref().filter(|server| has_ready(server)) {
                    *used.entry((server.clone(), world)).or_default() += 1;
                }
                picked
            } else {
                fleet.pick_admitted(now.instant, true, terms)
            };
            match picked {
                None => {
                    if !self.links.keys().any(passes_over) {
                        exhausted.insert(class);
                    }
                    if !shares.starved.contains(&class) {
                        shares.starved.push(class);
                    }
                }
                Some(server) if self.links.contains_key(&server) => {
                    shares.assigned.entry(server.clone()).or_default().push(*place);
                    shares.placed.push(server);
                }
                Some(server) => shares.plain.push((*place, server)),
            }
        }
        shares.starved.sort_unstable();
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
        let mut classes = self.line.classes().iter();
        classes.any(|class| class.waiting > 0 && admission(server, &class.world, load).is_some())
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
        let mut worlds = Vec::new();
        let mut seen = HashSet::new();
        for (place, waiting) in self.line.iter() {
            if seen.len() == self.line.repositories() {
                break;
            }
            let group = &waiting.group;
            if seen.insert(&group.repository) {
                worlds.push(WaitingFor {
                    repository: group.world.repository(),
                    waiting: self.line.count_of(group),
                    since: place.since,
                    longest: Duration::from_millis(now.saturating_sub(place.since)),
                });
            }
        }
        LineStatus {
            waiting: self.line.len(),
            worlds,
        }
    }

    /// The clients whose tickets must be sent again.
    pub fn renewals(&mut self, now: Instant) -> Vec<(Client, Place)> {
        self.line.renewals(now, Ticket::RENEWAL)
    }

    /// How the clients stand that have just come.
    pub fn first_news(&mut self, now: Instant) -> Vec<(Client, Position)> {
        let newcomers = std::mem::take(&mut self.newcomers);
        let Some(first) = newcomers.into_iter().min() else {
            return Vec::new();
        };
        let Self { line, links, rates, .. } = self;
        line.first_news(first, |classes, class| doors(links, rates, classes, class, now), now)
    }

    /// For each client the progress that it has to hear now, if any.
    pub fn news(&mut self, now: Instant) -> Vec<(Client, Position)> {
        self.newcomers.clear();
        let Self { line, links, rates, .. } = self;
        let classes = line.classes();
        let all = 0..classes.iter().count();
        let doors: Vec<Doors> = all.map(|class| doors(links, rates, classes, class, now)).collect();
        line.news(&doors, now)
    }
}

/// What is known of the servers that take a class.
fn doors<Server: Clone + Eq + Hash>(
    links: &HashMap<Server, Link>,
    rates: &mut HashMap<Server, (u64, Rate)>,
    classes: &Classes<Server>,
    class: ClassId,
    now: Instant,
) -> Doors {
    let queues = classes.servers_of(class).filter_map(|server| links.get(server));
    let mut queue: Vec<u64> = queues.flat_map(|link| &link.queue).copied().collect();
    queue.sort_unstable();
    let rates = classes
        .servers_of(class)
        .filter_map(|server| rates.get_mut(server).map(|(_, rate)| rate.freed(now)));
    let basis = Basis::of(rates);
    Doors { queue, basis }
}

/// What a look at the fleet yields.
struct Shares<Server> {
    /// The clients for which reserving servers have room.
    assigned: HashMap<Server, Vec<Place>>,
    /// The classes of which somebody gets no slot.
    starved: Vec<ClassId>,
    /// The clients that servers take which only report.
    plain: Vec<(Place, Server)>,
    /// The reserving servers, once for each client that is counted as sent there.
    placed: Vec<Server>,
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::fmt::Debug;

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
        load: f64,
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

    fn terms(servers: &[FakeServer]) -> impl Fn(&usize, &ProjectUrl) -> Option<Terms> + use<> {
        let accepts = accepts(servers);
        let terms = Terms {
            admission: Admission::Dedicated,
            is_open: true,
        };
        move |server, world| accepts(server, world).then_some(terms)
    }

    /// A client that wants a world of this owner.
    fn entry(owner: usize, number: u64) -> Entry<u64> {
        let world = format!("https://github.com/{}/a/blob/main/worlds/a.wbt", OWNERS[owner]);
        Entry {
            world: ProjectUrl::parse(&world).unwrap(),
            client: number,
            wait: number,
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
                load: 0.0,
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
            let all: Vec<usize> = (0..servers.len()).collect();
            fleet.dispatcher.set_servers(&all, terms(&fleet.servers));
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
                    ..ServerReport::load_only(Load::try_from(server.load).unwrap())
                };
                self.balancer.report(&id, self.now.instant, &report, true);
                self.dispatcher.count_freed(&id, server.freed, self.now.instant);
            }
        }

        fn enter(&mut self, owner: usize, ticket: Option<Ticket>, number: u64) -> Entered<usize, u64> {
            let entry = entry(owner, number);
            let terms = terms(&self.servers);
            let entered = self.dispatcher.enter(ticket, entry, number, |_| true, terms, self.now);
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
            self.dispatcher.leave(number);
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
        let first = fleet.dispatcher.first_news(fleet.now.instant);
        let mut news = fleet.dispatcher.news(fleet.now.instant);
        assert_eq!(news, [], "they have heard it");
        news.extend(first.into_iter().rev());
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
        let news = fleet.dispatcher.news(fleet.now.instant);
        let estimates: Vec<_> = news.iter().map(|(_, progress)| progress.estimate).collect();
        assert_eq!(estimates, [Some(20), None], "six slots in 110 seconds, and none");
    }

    /// The place of somebody who waits, and took it from nobody.
    fn alone<Server: Debug, Client: Debug>(entered: Entered<Server, Client>) -> Place {
        match entered {
            Entered::Waits(place, displaced) if displaced.is_empty() => place,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_turn_is_resumed_while_its_pass_holds_and_its_ticket_is_used_once() {
        let mut fleet = Fleet::new(&[(&[0], true, 1)]);
        let place = alone(fleet.enter(0, None, 1));
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
        let again = alone(fleet.enter(0, ticket, 3));
        assert_eq!(
            again,
            Place {
                since: fleet.now.unix,
                number: 3
            }
        );
    }

    #[test]
    fn whose_server_takes_nobody_any_more_has_its_place_again() {
        for reserves in [true, false] {
            let mut fleet = Fleet::new(&[(&[0], reserves, 1)]);
            let place = alone(fleet.enter(0, None, 1));
            fleet.free(0);
            assert_eq!(fleet.turns, [(1, 0)]);
            let sent = fleet.now.unix;
            let terms = terms(&fleet.servers);
            let ticket = Some(Ticket { place, sent });
            let entered = fleet
                .dispatcher
                .enter(ticket, entry(0, 2), 2, |_| false, terms, fleet.now);
            assert_eq!(entered, Entered::Waits(place, Vec::new()));
        }
    }

    #[test]
    fn a_slot_for_the_world_that_a_client_wanted_before_goes_back() {
        let mut fleet = Fleet::new(&[(&[0], true, 1), (&[1], true, 1)]);
        let place = alone(fleet.enter(0, None, 1));
        // Its ticket is used again, for a world that only the other server takes.
        let (terms, sent) = (terms(&fleet.servers), fleet.now.unix);
        let ticket = Some(Ticket { place, sent });
        fleet
            .dispatcher
            .enter(ticket, entry(1, 1), 1, |_| true, terms, fleet.now);
        fleet.servers[0].taken -= 1;
        fleet.offer(0, u64::MAX);
        assert_eq!(fleet.turns, []);
        // Somebody who takes the slot that goes back.
        fleet.waiting.clear();
        fleet.enter(0, None, 2);
        assert_eq!(fleet.turns, [(2, 0)]);
    }

    #[test]
    fn whose_server_is_gone_has_its_place_again_and_whose_pass_is_used_has_not() {
        let mut fleet = Fleet::new(&[(&[0], true, 2)]);
        let first = alone(fleet.enter(0, None, 1));
        fleet.pass_time(Duration::from_millis(1));
        let second = alone(fleet.enter(0, None, 2));
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
        assert_eq!(fleet.enter(0, again(first), 3), Entered::Waits(first, Vec::new()));
        let since = fleet.now.unix;
        assert_eq!(
            fleet.enter(0, again(second), 4),
            Entered::Waits(Place { since, number: 4 }, Vec::new())
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
    fn no_more_have_their_turn_at_once_than_the_load_leaves_room_for() {
        let mut fleet = Fleet::new(&[(&[0], true, 60)]);
        fleet.balancer.set_policy(PlacementPolicy::default());
        fleet.servers[0].taken = 0;
        fleet.servers[0].load = 96.0;
        for _ in 0..2 {
            fleet.report();
            fleet.pass_time(Duration::from_secs(20));
        }
        for number in 1..=50 {
            fleet.enter(0, None, number);
        }
        assert_eq!(fleet.turns, []);
        // At 95 % it takes nobody, and a client costs 2 %.
        fleet.servers[0].load = 92.0;
        fleet.report();
        fleet.serve();
        assert_eq!(fleet.turns, [(1, 0), (2, 0)]);
    }

    #[test]
    fn five_thousand_who_wait_cost_little() {
        let mut fleet = Fleet::new(&[(&[0], true, 10), (&[0, 1], true, 10)]);
        for number in 1..=5_000 {
            fleet.pass_time(Duration::from_millis(1));
            let owner = usize::from(number % 2 == 0);
            let terms = terms(&fleet.servers);
            let entry = entry(owner, number);
            fleet.dispatcher.enter(None, entry, number, |_| true, terms, fleet.now);
        }
        fleet.dispatcher.news(fleet.now.instant);
        let mut sent = 0;
        for _ in 0..60 {
            fleet.pass_time(Duration::from_secs(1));
            let first = *fleet.dispatcher.line.iter().next().unwrap().0;
            fleet.dispatcher.line.remove(first);
            sent += fleet.dispatcher.news(fleet.now.instant).len();
        }
        assert!(sent < 60 * 700, "{sent} messages in a minute");
    }
}
