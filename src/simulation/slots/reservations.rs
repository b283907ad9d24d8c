//! Slots that are reserved for clients of the line of a session server, and who wants one. Part of the slot pool.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::net::IpAddr;
use std::time::{Duration, Instant};

use actix::{Message, Recipient};

use super::simulation_record::Party;
use crate::shared::domain::{Failure, Offer, Offers, Passed, ProjectUrl, Reason, ReservationId, Wish, Wishes};
use crate::shared::http::AddressQuota;
use crate::simulation::simulation_id::SimulationId;

/// What a session server must be told.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Reserved(pub Offers);

/// The connection of a session server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkId(pub u64);

/// All reservations, and the session servers whose clients want some.
pub(super) struct Reservations {
    /// How long one holds.
    valid: Duration,
    links: BTreeMap<LinkId, Link>,
    pub(super) reserved: HashMap<ReservationId, Reservation>,
    /// The last reservations whose clients have come.
    used: VecDeque<ReservationId>,
    /// Limits the reservations of an address that expire. An address beyond it comes after the others for a while: each
    /// takes a slot from those who would use it.
    expired: AddressQuota,
    behind: HashMap<IpAddr, Instant>,
}

/// A slot that waits for its client.
pub(super) struct Reservation {
    /// What it holds.
    pub(super) held: Held,
    /// The address and the user that it counts for, each with its limit.
    pub(super) parties: Vec<(Party, usize)>,
    /// When its client has entered the line.
    pub(super) since: Instant,
    address: Option<IpAddr>,
    until: Instant,
    link: LinkId,
}

/// What a reservation holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Held {
    /// A free port.
    Port(u16),
    /// A simulation that is kept ready. Its client takes it, or it ends and the client gets its port.
    Spare(SimulationId),
}

impl Held {
    /// The simulation that is kept ready.
    pub(super) fn spare(self) -> Option<SimulationId> {
        match self {
            Self::Port(_) => None,
            Self::Spare(id) => Some(id),
        }
    }
}

/// A client of a session server.
pub(super) struct Wanted {
    ticket: u64,
    since: Instant,
    address: Option<IpAddr>,
    parties: Vec<(Party, usize)>,
    world: Option<ProjectUrl>,
}

struct Link {
    wanted: VecDeque<Wanted>,
    /// Number of clients that want a slot, of which `wanted` are the first.
    all: usize,
    listener: Recipient<Reserved>,
    /// What it must be told, if anything.
    news: Offers,
    has_news: bool,
    /// When the clients of the queue have come, as it was told last.
    queue: Vec<Instant>,
    /// Whom of those in `wanted` this server passes over, as it was told last.
    passed: Vec<Passed>,
}

/// A place in the order of all who want a slot: who is behind comes after the others.
pub(super) type Order = (bool, Instant);

/// Number of used reservations that are known as such.
const USED: usize = 1000;

impl Reservations {
    /// No reservations; each will hold this long.
    pub(super) fn new(valid: Duration) -> Self {
        Self {
            valid,
            links: BTreeMap::new(),
            reserved: HashMap::new(),
            used: VecDeque::new(),
            expired: AddressQuota::new(20, 12),
            behind: HashMap::new(),
        }
    }

    /// A session server has connected. It is told at once that it may ask.
    pub(super) fn open(&mut self, id: LinkId, listener: Recipient<Reserved>) {
        let link = Link {
            wanted: VecDeque::new(),
            all: 0,
            listener,
            news: Offers::default(),
            has_news: true,
            queue: Vec::new(),
            passed: Vec::new(),
        };
        self.links.insert(id, link);
    }

    /// A session server has left. What is reserved for its clients stays: they have their passes.
    pub(super) fn close(&mut self, id: LinkId) {
        self.links.remove(&id);
    }

    /// The clients of a session server that want slots. `parties` are those that a client counts for.
    pub(super) fn wish(&mut self, id: LinkId, wishes: &Wishes, parties: impl Fn(&Wish) -> Vec<(Party, usize)>) {
        for back in &wishes.back {
            self.reserved.remove(back);
        }
        let Some(link) = self.links.get_mut(&id) else { return };
        let now = Instant::now();
        let known: HashMap<u64, Instant> = link.wanted.iter().map(|one| (one.ticket, one.since)).collect();
        let wanted = wishes.first.iter().map(|wish| {
            let since = now.checked_sub(Duration::from_millis(wish.waited)).unwrap_or(now);
            Wanted {
                ticket: wish.ticket,
                // The message that was the least time on its way tells it best.
                since: known.get(&wish.ticket).map_or(since, |known| since.min(*known)),
                address: wish.address,
                parties: parties(wish),
                world: wish.world.clone(),
            }
        });
        link.wanted = wanted.collect();
        // Their order is exact. The times are not: messages round them, and are on their way for some time.
        let mut next: Option<Instant> = None;
        for one in link.wanted.iter_mut().rev() {
            one.since = next.map_or(one.since, |next| one.since.min(next));
            next = Some(one.since);
        }
        link.all = (wishes.all as usize).max(link.wanted.len());
        link.news.number = wishes.number;
        link.has_news = true;
    }

    /// No client of a session server wants a slot any more.
    pub(super) fn clear(&mut self, id: LinkId) {
        if let Some(link) = self.links.get_mut(&id) {
            link.wanted.clear();
            link.all = 0;
        }
    }

    /// The first client that may have a slot: its session server, its index there, and its place in the order.
    pub(super) fn first(&self, may_have: impl Fn(&[(Party, usize)]) -> bool) -> Option<(LinkId, usize, Order)> {
        let mut first: Option<(LinkId, usize, Order)> = None;
        for (id, link) in &self.links {
            for (index, wanted) in link.wanted.iter().enumerate() {
                let order = (self.is_behind(wanted.address), wanted.since);
                if first.is_none_or(|(.., best)| order < best) && may_have(&wanted.parties) {
                    first = Some((*id, index, order));
                }
            }
        }
        first
    }

    /// Whether an address comes after the others.
    pub(super) fn is_behind(&self, address: Option<IpAddr>) -> bool {
        address.is_some_and(|address| self.behind.contains_key(&address))
    }

    /// The world of a client.
    pub(super) fn world(&self, id: LinkId, index: usize) -> Option<&ProjectUrl> {
        self.links.get(&id)?.wanted.get(index)?.world.as_ref()
    }

    /// Whether a simulation that is kept ready is promised to a client.
    pub(super) fn holds(&self, id: SimulationId) -> bool {
        self.reserved.values().any(|one| one.held == Held::Spare(id))
    }

    /// A simulation that was kept ready has left its port: who it was promised to gets that.
    pub(super) fn keep_port(&mut self, id: SimulationId, port: u16) {
        for one in self.reserved.values_mut().filter(|one| one.held == Held::Spare(id)) {
            one.held = Held::Port(port);
        }
    }

    /// Reserves a port, or a simulation that is kept ready, for a client.
    pub(super) fn reserve(&mut self, id: LinkId, index: usize, held: Held) {
        let Some(link) = self.links.get_mut(&id) else { return };
        let Some(wanted) = link.wanted.remove(index) else {
            return;
        };
        link.all = link.all.saturating_sub(1);
        let reservation = ReservationId(rand::random());
        link.news.offers.push(Offer {
            ticket: wanted.ticket,
            reservation,
        });
        link.has_news = true;
        let seconds = wanted.since.elapsed().as_secs_f64();
        let what = match held {
            Held::Port(port) => format!("the slot of port {port}"),
            Held::Spare(id) => format!("{id}, which is kept ready,"),
        };
        log::info!("{what} is reserved for a client of the line, which has waited {seconds:.1} s");
        let reserved = Reservation {
            held,
            parties: wanted.parties,
            since: wanted.since,
            address: wanted.address,
            until: Instant::now() + self.valid,
            link: id,
        };
        self.reserved.insert(reservation, reserved);
    }

    /// The reservation of a client that has come.
    ///
    /// # Errors
    /// When it was used already, or does not hold any more.
    pub(super) fn redeem(&mut self, id: ReservationId) -> Result<Reservation, Failure> {
        let Some(reservation) = self.reserved.remove(&id) else {
            return Err(if self.used.contains(&id) {
                Failure::new(Reason::UsedPass, "This pass was used already")
            } else {
                Failure::new(Reason::ExpiredPass, "This pass was not used in time")
            });
        };
        self.used.truncate(USED - 1);
        self.used.push_front(id);
        if let Some(link) = self.links.get_mut(&reservation.link) {
            link.news.used.push(id);
            link.has_news = true;
        }
        Ok(reservation)
    }

    /// Frees the slots whose clients have not come in time. Returns whether there were any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        self.behind.retain(|_, until| now < *until);
        let before = self.reserved.len();
        let Self {
            reserved,
            expired,
            behind,
            valid,
            ..
        } = self;
        reserved.retain(|_, reservation| {
            let holds = now < reservation.until;
            if !holds
                && let Some(address) = reservation.address
                && !expired.take(Some(address))
            {
                behind.insert(address, now + *valid);
            }
            holds
        });
        reserved.len() < before
    }

    /// Number of clients of session servers that have come before this time.
    pub(super) fn ahead_of(&self, since: Instant) -> usize {
        let ahead = |link: &Link| {
            let listed = link.wanted.iter().filter(|wanted| wanted.since < since).count();
            // Of those that are not listed it is only known that they came later than all that are.
            if listed == link.wanted.len() { link.all } else { listed }
        };
        self.links.values().map(ahead).sum()
    }

    /// Number of clients of session servers that may have a slot.
    pub(super) fn waiting(&self, may_have: impl Fn(&[(Party, usize)]) -> bool) -> usize {
        let wanted = self.links.values().flat_map(|link| &link.wanted);
        wanted.filter(|wanted| may_have(&wanted.parties)).count()
    }

    /// Tells each session server what is new. `queue` is when the clients of the queue have come, `has_share` whether an
    /// address or user has all the slots that it may have.
    pub(super) fn tell(&mut self, free: usize, queue: &[Instant], has_share: impl Fn(&(Party, usize)) -> bool) {
        let now = Instant::now();
        for link in self.links.values_mut() {
            let passed = passed_over(&link.wanted, &self.behind, &has_share);
            if !link.has_news && link.queue == queue && link.passed == passed {
                continue;
            }
            queue.clone_into(&mut link.queue);
            link.passed.clone_from(&passed);
            let waited = |since: &Instant| u64::try_from(now.duration_since(*since).as_millis()).unwrap_or(u64::MAX);
            let number = link.news.number;
            let news = Offers {
                free: u32::try_from(free).unwrap_or(u32::MAX),
                queue: queue.iter().map(waited).collect(),
                passed,
                ..std::mem::take(&mut link.news)
            };
            link.news.number = number;
            link.has_news = false;
            link.listener.do_send(Reserved(news));
        }
    }
}

/// Whom of these a server passes over for now, each once.
fn passed_over(
    wanted: &VecDeque<Wanted>,
    behind: &HashMap<IpAddr, Instant>,
    has_share: impl Fn(&(Party, usize)) -> bool,
) -> Vec<Passed> {
    let mut passed = Vec::new();
    for one in wanted {
        let is_behind = one.address.filter(|address| behind.contains_key(address));
        let full = one.parties.iter().filter(|party| has_share(party));
        let full = full.map(|(party, _)| match party {
            Party::Address(address) => Passed::Address(*address),
            Party::User(user) => Passed::User(user.clone()),
        });
        for found in full.chain(is_behind.map(Passed::Address)) {
            if !passed.contains(&found) {
                passed.push(found);
            }
        }
    }
    passed
}
