//! Slots that are reserved for clients of the line of a session server, and who wants one. Part of the slot pool.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::net::IpAddr;
use std::time::{Duration, Instant};

use actix::{Message, Recipient};

use super::simulation_record::{Client, Party};
use crate::shared::domain::{Failure, Offer, Offers, PassedOver, ProjectUrl, Reason, ReservationId, Wish, Wishes};
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
    lines: BTreeMap<LinkId, Line>,
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
    until: Instant,
    of: ReservedFor,
}

/// Whom a reservation is for.
enum ReservedFor {
    /// A client of a session server, with this address.
    InLine(LinkId, Option<IpAddr>),
    /// A client that is here, and was about to take this simulation, which was kept ready and has failed.
    TakerOf(SimulationId),
}

impl Reservation {
    /// The session server that has sent its client; `None` if that client was here before.
    pub(super) fn link(&self) -> Option<LinkId> {
        match self.of {
            ReservedFor::InLine(link, _) => Some(link),
            ReservedFor::TakerOf(_) => None,
        }
    }
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

/// The line of a session server, as far as this server knows it.
struct Line {
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
    passed: Vec<PassedOver>,
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
            lines: BTreeMap::new(),
            reserved: HashMap::new(),
            used: VecDeque::new(),
            expired: AddressQuota::new(20, 12),
            behind: HashMap::new(),
        }
    }

    /// A session server has connected. It is told at once that it may ask.
    pub(super) fn open(&mut self, id: LinkId, listener: Recipient<Reserved>) {
        let line = Line {
            wanted: VecDeque::new(),
            all: 0,
            listener,
            news: Offers::default(),
            has_news: true,
            queue: Vec::new(),
            passed: Vec::new(),
        };
        self.lines.insert(id, line);
    }

    /// A session server has left. What is reserved for its clients stays: they have their passes.
    pub(super) fn close(&mut self, id: LinkId) {
        self.lines.remove(&id);
    }

    /// The clients of a session server that want slots. `parties` are those that a client counts for.
    pub(super) fn wish(&mut self, id: LinkId, wishes: &Wishes, parties: impl Fn(&Wish) -> Vec<(Party, usize)>) {
        for back in &wishes.back {
            self.reserved.remove(back);
        }
        let Some(line) = self.lines.get_mut(&id) else { return };
        let now = Instant::now();
        let known: HashMap<u64, Instant> = line.wanted.iter().map(|one| (one.ticket, one.since)).collect();
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
        line.wanted = wanted.collect();
        // Their order is exact. The times are not: messages round them, and are on their way for some time.
        let mut next: Option<Instant> = None;
        for one in line.wanted.iter_mut().rev() {
            one.since = next.map_or(one.since, |next| one.since.min(next));
            next = Some(one.since);
        }
        line.all = (wishes.all as usize).max(line.wanted.len());
        line.news.number = wishes.number;
        line.has_news = true;
    }

    /// No client of a session server wants a slot any more.
    pub(super) fn clear(&mut self, id: LinkId) {
        if let Some(line) = self.lines.get_mut(&id) {
            line.wanted.clear();
            line.all = 0;
        }
    }

    /// The first client that may have a slot: its session server, its index there, and its place in the order.
    pub(super) fn first(&self, may_have: impl Fn(&[(Party, usize)]) -> bool) -> Option<(LinkId, usize, Order)> {
        let mut first: Option<(LinkId, usize, Order)> = None;
        for (id, line) in &self.lines {
            for (index, wanted) in line.wanted.iter().enumerate() {
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
        self.lines.get(&id)?.wanted.get(index)?.world.as_ref()
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
        let Some(line) = self.lines.get_mut(&id) else { return };
        let Some(wanted) = line.wanted.remove(index) else {
            return;
        };
        line.all = line.all.saturating_sub(1);
        let reservation = ReservationId(rand::random());
        line.news.offers.push(Offer {
            ticket: wanted.ticket,
            reservation,
        });
        line.has_news = true;
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
            until: Instant::now() + self.valid,
            of: ReservedFor::InLine(id, wanted.address),
        };
        self.reserved.insert(reservation, reserved);
    }

    /// A simulation that was kept ready has left its port before its session knew of the client that takes it: that client
    /// gets the port.
    pub(super) fn keep_for(&mut self, reservation: ReservationId, failed: SimulationId, port: u16, client: &Client) {
        let reserved = Reservation {
            held: Held::Port(port),
            parties: client.parties.clone(),
            since: client.since,
            until: Instant::now() + self.valid,
            of: ReservedFor::TakerOf(failed),
        };
        self.reserved.insert(reservation, reserved);
    }

    /// Whether a client is on its way that was about to take this simulation, which has failed.
    pub(super) fn expects_taker(&self, failed: SimulationId) -> bool {
        let is_for = |one: &Reservation| matches!(one.of, ReservedFor::TakerOf(id) if id == failed);
        self.reserved.values().any(is_for)
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
        let line = reservation.link().and_then(|link| self.lines.get_mut(&link));
        if let Some(line) = line {
            line.news.used.push(id);
            line.has_news = true;
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
                && let ReservedFor::InLine(_, Some(address)) = reservation.of
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
        let ahead = |line: &Line| {
            let listed = line.wanted.iter().filter(|wanted| wanted.since < since).count();
            // Of those that are not listed it is only known that they came later than all that are.
            if listed == line.wanted.len() { line.all } else { listed }
        };
        self.lines.values().map(ahead).sum()
    }

    /// Number of clients of session servers that may have a slot.
    pub(super) fn waiting(&self, may_have: impl Fn(&[(Party, usize)]) -> bool) -> usize {
        let wanted = self.lines.values().flat_map(|line| &line.wanted);
        wanted.filter(|wanted| may_have(&wanted.parties)).count()
    }

    /// Tells each session server what is new. `queue` is when the clients of the queue have come, `has_share` whether an
    /// address or user has all the slots that it may have.
    pub(super) fn tell(&mut self, free: usize, queue: &[Instant], has_share: impl Fn(&(Party, usize)) -> bool) {
        let now = Instant::now();
        for line in self.lines.values_mut() {
            let passed = passed_over(&line.wanted, &self.behind, &has_share);
            if !line.has_news && line.queue == queue && line.passed == passed {
                continue;
            }
            queue.clone_into(&mut line.queue);
            line.passed.clone_from(&passed);
            let waited = |since: &Instant| u64::try_from(now.duration_since(*since).as_millis()).unwrap_or(u64::MAX);
            let number = line.news.number;
            let news = Offers {
                free: u32::try_from(free).unwrap_or(u32::MAX),
                queue: queue.iter().map(waited).collect(),
                passed,
                ..std::mem::take(&mut line.news)
            };
            line.news.number = number;
            line.has_news = false;
            line.listener.do_send(Reserved(news));
        }
    }
}

/// Whom of these a server passes over for now, each once.
fn passed_over(
    wanted: &VecDeque<Wanted>,
    behind: &HashMap<IpAddr, Instant>,
    has_share: impl Fn(&(Party, usize)) -> bool,
) -> Vec<PassedOver> {
    let mut passed = Vec::new();
    for one in wanted {
        let is_behind = one.address.filter(|address| behind.contains_key(address));
        let full = one.parties.iter().filter(|party| has_share(party));
        let full = full.map(|(party, _)| match party {
            Party::Address(address) => PassedOver::Address(*address),
            Party::User(user) => PassedOver::User(user.clone()),
        });
        for found in full.chain(is_behind.map(PassedOver::Address)) {
            if !passed.contains(&found) {
                passed.push(found);
            }
        }
    }
    passed
}
