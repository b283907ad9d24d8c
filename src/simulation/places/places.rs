//! Actor: lends places to simulations, keeps the waiting line, and knows all simulations of this server.
//!
//! One for the whole server, created at start; it never ends. A place is a streaming port. Whoever wants one makes a
//! [`Ticket`] and then hears how many are ahead, until a port is granted. Dropping the ticket leaves the line or frees
//! the port, so that neither is lost in any state or by any panic.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::io::ErrorKind;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, TcpListener};
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use actix::prelude::*;

use super::messages::{Acquire, GetSnapshot, Move, PlaceEvent, Release, Update};
use super::no_place::NoPlace;
use crate::shared::domain::Instances;
use crate::shared::run::seconds_since_1970;
use crate::simulation::snapshot::{Change, Simulation, Snapshot, Stage};

/// A place, or a place in the line for one. Dropping it gives it back.
#[derive(Debug)]
pub struct Ticket {
    id: u64,
    places: Addr<Places>,
}

/// The actor.
pub struct Places {
    ports: RangeInclusive<u16>,
    longest_line: usize,
    /// How many places an address may have, and how many clients of it may wait; `None` for as many as there are.
    per_address: Option<(usize, usize)>,
    /// How many tickets there were, also of clients that were refused.
    arrivals: u64,
    present: BTreeMap<u64, Present>,
    line: VecDeque<Waiting>,
}

struct Present {
    /// The port that is lent, which is not always the one that Webots took.
    lent: Option<u16>,
    address: Option<IpAddr>,
    client: Recipient<PlaceEvent>,
    shown: Simulation,
}

struct Waiting {
    id: u64,
    address: Option<IpAddr>,
    client: Recipient<PlaceEvent>,
    told: Option<usize>,
}

/// Time between two checks whether a port is free again that somebody outside of this server has taken.
const RECHECK: Duration = Duration::from_secs(1);

impl Places {
    /// Lends these ports; `longest_line` clients may wait. One address may have `per_address` places, and the same part of
    /// the line; without it, all of both.
    #[must_use]
    pub fn new(ports: RangeInclusive<u16>, longest_line: usize, per_address: Option<usize>) -> Self {
        let all = ports.len().max(1);
        let per_address = per_address.map(|places| (places, (longest_line * places.min(all)).div_ceil(all)));
        Self { ports, longest_line, per_address, arrivals: 0, present: BTreeMap::new(), line: VecDeque::new() }
    }

    /// The first in the line whose address may have another place.
    fn next_in_line(&self) -> Option<usize> {
        let Some((most, _)) = self.per_address else {
            return (!self.line.is_empty()).then_some(0);
        };
        let mut lent: HashMap<IpAddr, usize> = HashMap::new();
        for address in self.present.values().filter(|one| one.lent.is_some()).filter_map(|one| one.address) {
            *lent.entry(address).or_default() += 1;
        }
        let has_room = |address: &IpAddr| lent.get(address).is_none_or(|count| *count < most);
        self.line.iter().position(|waiting| waiting.address.as_ref().is_none_or(has_room))
    }

    /// How many places the clients of an address have, and how many of them wait.
    fn of_address(&self, address: IpAddr) -> (usize, usize) {
        let present = self.present.values().filter(|one| one.address == Some(address));
        let (lent, waiting): (Vec<_>, Vec<_>) = present.partition(|one| one.lent.is_some());
        (lent.len(), waiting.len())
    }

    /// Why another client of this address gets no place and may not wait, if so.
    fn refusal(&self, address: Option<IpAddr>) -> Option<NoPlace> {
        let share = self.per_address.zip(address).map(|(most, address)| (most, self.of_address(address)));
        let may_have_one = share.is_none_or(|((most, _), (places, _))| places < most);
        if may_have_one && self.next_in_line().is_none() && self.free_port().is_some() {
            return None;
        }
        if let Some(((_, most), (places, waiting))) = share
            && waiting >= most
            && (!may_have_one || waiting > 0)
        {
            return Some(NoPlace::Share { places, waiting });
        }
        let (places, waiting) = (self.ports.len(), self.line.len());
        (waiting >= self.longest_line).then_some(NoPlace::Full { places, waiting })
    }

    /// Gives free places to those who wait, and tells the others how many are ahead.
    fn serve(&mut self) {
        while let Some(next) = self.next_in_line()
            && let Some(port) = self.free_port()
            && let Some(first) = self.line.remove(next)
        {
            match first.client.try_send(PlaceEvent::Granted(port)) {
                Ok(()) => self.lend(first.id, port),
                // It stays where it is in the line until the next check.
                Err(SendError::Full(_)) => {
                    self.line.insert(next, first);
                    break;
                }
                // Its actor has stopped, which drops its ticket too.
                Err(SendError::Closed(_)) => {}
            }
        }
        for (ahead, waiting) in self.line.iter_mut().enumerate() {
            if waiting.told != Some(ahead) && waiting.client.try_send(PlaceEvent::Ahead(ahead)).is_ok() {
                waiting.told = Some(ahead);
            }
        }
    }

    /// Simulations whose clients are away hold half of the places at most, or one where there is only one.
    fn end_longest_away(&mut self) {
        let most = (self.ports.len() / 2).max(1);
        let away = || self.present.values().filter(|one| one.shown.away_until.is_some());
        if away().count() > most
            && let Some(id) = away().min_by_key(|one| one.shown.away_until).map(|one| one.shown.id)
            && let Some(longest) = self.present.get_mut(&id)
        {
            longest.shown.away_until = None;
            longest.client.do_send(PlaceEvent::AwayTooLong);
        }
    }

    fn lend(&mut self, id: u64, port: u16) {
        if let Some(present) = self.present.get_mut(&id) {
            present.lent = Some(port);
            present.shown.port = Some(port);
            present.shown.stage = Stage::CheckingOut;
        }
    }

    /// The lowest port that is neither lent nor used by anybody else.
    fn free_port(&self) -> Option<u16> {
        let taken: HashSet<u16> = self.present.values().flat_map(|one| [one.lent, one.shown.port]).flatten().collect();
        self.ports.clone().filter(|port| !taken.contains(port)).find(|port| is_free(*port))
    }

    fn instances(&self) -> Instances {
        let count = |stages: &[Stage]| {
            let matching = self.present.values().filter(|one| stages.contains(&one.shown.stage)).count();
            u32::try_from(matching).unwrap_or(u32::MAX)
        };
        Instances {
            queued: count(&[Stage::Queued]),
            starting: count(&[Stage::CheckingOut, Stage::Launching]),
            idle: count(&[Stage::Idle, Stage::Stopping]),
            running: count(&[Stage::Running]),
            places: u32::try_from(self.ports.len()).unwrap_or(u32::MAX),
            arrivals: self.arrivals,
        }
    }
}

/// Whether nobody listens on a port, by either version of IP; a machine may have but one of them.
fn is_free(port: u16) -> bool {
    let is_taken = |error: std::io::Error| error.kind() == ErrorKind::AddrInUse;
    TcpListener::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok()
        && !TcpListener::bind((Ipv6Addr::UNSPECIFIED, port)).is_err_and(is_taken)
}

impl Actor for Places {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.run_interval(RECHECK, |places, _| places.serve());
    }
}

impl Handler<Acquire> for Places {
    type Result = ();

    fn handle(&mut self, Acquire { id, client, world, address }: Acquire, _: &mut Self::Context) {
        self.arrivals += 1;
        if let Some(refusal) = self.refusal(address) {
            return client.do_send(PlaceEvent::Refused(refusal));
        }
        let shown = Simulation {
            id,
            world,
            stage: Stage::Queued,
            since: seconds_since_1970(),
            launched: None,
            pid: None,
            cgroup: None,
            port: None,
            away_until: None,
            version: None,
            log: None,
            log_begin: 0,
        };
        self.present.insert(id, Present { lent: None, address, client: client.clone(), shown });
        self.line.push_back(Waiting { id, address, client, told: None });
        self.serve();
    }
}

impl Handler<Release> for Places {
    type Result = ();

    fn handle(&mut self, Release(id): Release, _: &mut Self::Context) {
        self.present.remove(&id);
        self.line.retain(|waiting| waiting.id != id);
        self.serve();
    }
}

impl Handler<Update> for Places {
    type Result = ();

    fn handle(&mut self, Update { id, change }: Update, _: &mut Self::Context) {
        let Some(Present { shown, .. }) = self.present.get_mut(&id) else {
            return;
        };
        let is_away = matches!(change, Change::Away(Some(_)));
        shown.apply(change);
        if is_away {
            self.end_longest_away();
        }
    }
}

impl Handler<Move> for Places {
    type Result = Result<(), NoPlace>;

    fn handle(&mut self, Move { id, address }: Move, _: &mut Self::Context) -> Self::Result {
        let is_there = self.present.get(&id).is_none_or(|one| one.address == address);
        let share = self.per_address.zip(address).filter(|_| !is_there);
        if let Some(((most, _), address)) = share
            && let (places, waiting) = self.of_address(address)
            && places >= most
        {
            return Err(NoPlace::Share { places, waiting });
        }
        if let Some(present) = self.present.get_mut(&id) {
            present.address = address;
        }
        Ok(())
    }
}

impl Handler<GetSnapshot> for Places {
    type Result = Snapshot;

    fn handle(&mut self, _: GetSnapshot, _: &mut Self::Context) -> Snapshot {
        let simulations = self.present.values().map(|one| one.shown.clone()).collect();
        Snapshot { instances: self.instances(), simulations }
    }
}

/// The number of the next ticket.
static NEXT: AtomicU64 = AtomicU64::new(1);

impl Ticket {
    /// Gets into the line for a place. `client` hears what comes of it, `world` is the URL that is shown, `address` the
    /// client's, where it is known.
    #[must_use]
    pub fn new(places: &Addr<Places>, client: Recipient<PlaceEvent>, world: String, address: Option<IpAddr>) -> Self {
        let id = NEXT.fetch_add(1, Ordering::Relaxed);
        places.do_send(Acquire { id, client, world, address });
        Self { id, places: places.clone() }
    }

    /// Tells what has changed in the simulation.
    pub fn update(&self, change: Change) {
        // The actor lives as long as the server; without it there is nothing to show.
        self.places.do_send(Update { id: self.id, change });
    }

    /// The number by which the actor knows it.
    #[must_use]
    pub fn id(&self) -> u64 {
        self.id
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.places.do_send(Release(self.id));
    }
}
