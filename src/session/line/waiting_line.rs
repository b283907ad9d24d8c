//! Who waits, in the order of arrival.

use std::cell::Cell;
use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::classes::{ClassId, Classes, Doors, Group, Terms};
use super::rate::estimate;
use crate::shared::domain::{PassedOver, ProjectUrl, Wish};

/// A place in the line. Places sort by the time of arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Place {
    /// When the client has arrived, in milliseconds since 1970.
    pub since: u64,
    /// The number of the ticket, which is random.
    pub number: u64,
}

/// A client that enters the line.
#[derive(Debug, Clone)]
pub struct Entry<Client> {
    /// Its world.
    pub world: ProjectUrl,
    /// Receives what happens to it.
    pub client: Client,
    /// Identifies its wait: it may come back, on another connection too, before this one is known to be over.
    pub wait: u64,
    /// Its address, if that is known.
    pub address: Option<IpAddr>,
    /// Its user, if a trusted reverse proxy names one.
    pub user: Option<String>,
    /// The name that it has chosen; it is not checked.
    pub label: Option<String>,
}

/// A client in the line, for administrators.
#[derive(Debug, Clone, Copy)]
pub struct WaitingClient<'line> {
    /// Its place.
    pub place: Place,
    /// Its world.
    pub world: &'line ProjectUrl,
    /// Its user.
    pub user: Option<&'line str>,
    /// The name that it has chosen.
    pub label: Option<&'line str>,
}

/// What a client in the line hears.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Position {
    /// Number of clients ahead that the same servers could take.
    pub ahead: u32,
    /// Seconds until its turn, as far as that can be estimated.
    pub estimate: Option<u32>,
}

/// A client in the line.
#[derive(Debug)]
pub(super) struct Waiting<Client> {
    label: Option<Box<str>>,
    pub(super) group: Rc<Group>,
    pub(super) world: Arc<ProjectUrl>,
    pub(super) client: Client,
    wait: u64,
    address: Option<IpAddr>,
    user: Option<Arc<str>>,
    /// What it heard last, and when.
    heard: Option<(Position, Instant)>,
    /// When its ticket was sent last.
    ticket: Instant,
}

/// The clients that wait. Everything about one of them is in one entry, and in the indices by number, wait and user.
#[derive(Debug)]
pub(super) struct WaitingLine<Server, Client> {
    waiting: BTreeMap<Place, Waiting<Client>>,
    since: HashMap<u64, u64>,
    waits: HashMap<u64, Place>,
    users: HashMap<Arc<str>, Place>,
    /// The groups of those who wait by their repositories, each with the number of them.
    groups: HashMap<String, (Rc<Group>, u32)>,
    classes: Classes<Server>,
}

impl<Server, Client> Default for WaitingLine<Server, Client> {
    fn default() -> Self {
        Self {
            waiting: BTreeMap::new(),
            since: HashMap::new(),
            waits: HashMap::new(),
            users: HashMap::new(),
            groups: HashMap::new(),
            classes: Classes::default(),
        }
    }
}

/// Shortest interval between two positions of a client. That of a client with more than a hundred ahead grows with its
/// position, so that a long line costs no more than a short one.
const INTERVAL: Duration = Duration::from_secs(1);
/// Most clients that a simulation server is told of.
pub(super) const LISTED: usize = 32;
/// Most clients of an address or user that a simulation server is told of while it passes these over: it needs the first
/// of them for its next slot that they may have.
const LISTED_OF_PASSED: usize = 2;
/// Most bytes of worlds and users' names that a simulation server is told of, unless one client has more: clients choose
/// their length.
const MAX_TEXTS: usize = 4096;

impl<Server: Clone + Eq, Client: Clone> WaitingLine<Server, Client> {
    /// Adds a client at a place. If its ticket or its user has a place already, the client takes that over: it gets the
    /// earliest of them. Returns its place, and the clients that have lost theirs. `terms` is on what terms a server
    /// takes a world.
    pub(super) fn enter(
        &mut self,
        place: Place,
        entry: Entry<Client>,
        terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>,
        now: Instant,
    ) -> (Place, Vec<Client>) {
        let user: Option<Arc<str>> = entry.user.map(Arc::from);
        let of_user = user.as_ref().and_then(|user| self.users.get(user)).copied();
        let of_ticket = self.place_of(place.number);
        let mut displaced = Vec::new();
        let mut first = place;
        for before in [of_ticket, of_user].into_iter().flatten() {
            first = first.min(before);
            displaced.extend(self.remove(before).map(|waiting| waiting.client));
        }
        let repository = entry.world.repository().to_lowercase();
        let classes = &mut self.classes;
        let (group, count) = self.groups.entry(repository.clone()).or_insert_with(|| {
            let world = Arc::new(entry.world.clone());
            let class = Cell::new(classes.of(&world, terms));
            let group = Group {
                world,
                repository,
                class,
            };
            (Rc::new(group), 0)
        });
        *count += 1;
        classes.add(group.class.get(), 1);
        // A class mostly waits for one world.
        let world = if *group.world == entry.world {
            Arc::clone(&group.world)
        } else {
            Arc::new(entry.world)
        };
        let waiting = Waiting {
            label: entry.label.map(String::into_boxed_str),
            group: Rc::clone(group),
            world,
            client: entry.client,
            wait: entry.wait,
            address: entry.address,
            user: user.clone(),
            heard: None,
            ticket: now,
        };
        self.since.insert(first.number, first.since);
        self.waits.insert(entry.wait, first);
        if let Some(user) = user {
            self.users.insert(user, first);
        }
        self.waiting.insert(first, waiting);
        (first, displaced)
    }

    /// Removes the client of a wait, if that is not over. Another one may have its place by now.
    pub(super) fn leave(&mut self, wait: u64) {
        if let Some(place) = self.waits.get(&wait) {
            self.remove(*place);
        }
    }

    /// Removes the client at a place.
    pub(super) fn remove(&mut self, place: Place) -> Option<Waiting<Client>> {
        let waiting = self.waiting.remove(&place)?;
        self.since.remove(&place.number);
        self.waits.remove(&waiting.wait);
        if let Some(user) = &waiting.user {
            self.users.remove(user);
        }
        self.classes.subtract_one(waiting.group.class.get());
        if let Some((_, count)) = self.groups.get_mut(&waiting.group.repository) {
            *count -= 1;
            if *count == 0 {
                self.groups.remove(&waiting.group.repository);
            }
        }
        Some(waiting)
    }

    /// The place of a ticket, if its client waits.
    pub(super) fn place_of(&self, number: u64) -> Option<Place> {
        let since = *self.since.get(&number)?;
        Some(Place { since, number })
    }

    /// The place of a ticket, if its client waits for a world that this server takes.
    pub(super) fn place_at(&self, server: &Server, number: u64) -> Option<Place> {
        let place = self.place_of(number)?;
        let class = self.waiting.get(&place)?.group.class.get();
        self.classes.may_use(class, server).then_some(place)
    }

    /// All who wait, in order, for administrators.
    pub(super) fn clients(&self) -> impl Iterator<Item = WaitingClient<'_>> {
        self.waiting.iter().map(|(place, waiting)| WaitingClient {
            place: *place,
            world: &waiting.world,
            user: waiting.user.as_deref(),
            label: waiting.label.as_deref(),
        })
    }

    /// All who wait, in order.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&Place, &Waiting<Client>)> {
        self.waiting.iter()
    }

    /// Number of those of a repository who wait.
    pub(super) fn count_of(&self, group: &Group) -> u32 {
        self.groups.get(&group.repository).map_or(0, |(_, count)| *count)
    }

    /// Number of the repositories that are waited for.
    pub(super) fn repositories(&self) -> usize {
        self.groups.len()
    }

    /// Who competes with whom.
    pub(super) fn classes(&self) -> &Classes<Server> {
        &self.classes
    }

    /// Number of those who wait.
    pub(super) fn len(&self) -> usize {
        self.waiting.len()
    }

    /// The fleet consists of these servers now.
    pub(super) fn set_servers(&mut self, servers: &[Server], terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>) {
        let groups = self.groups.values().map(|(group, count)| (group, *count));
        self.classes.set_servers(servers, groups, terms);
    }

    /// A server has other rules now.
    pub(super) fn rules_changed(&mut self, server: &Server, terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>) {
        let groups = self.groups.values().map(|(group, count)| (group, *count));
        self.classes.rules_changed(server, groups, terms);
    }

    /// The first clients of these classes, as many as a simulation server is told of. `passed` are those whom it passes
    /// over; with `only_passed`, it is told of no others.
    pub(super) fn told_of(&self, classes: &[ClassId], passed: &[PassedOver], only_passed: bool) -> Vec<Place> {
        let mut listed = Vec::new();
        let mut passed: Vec<(&PassedOver, usize)> = passed.iter().map(|one| (one, LISTED_OF_PASSED)).collect();
        let mut texts = 0;
        for (place, waiting) in &self.waiting {
            if listed.len() == LISTED {
                break;
            }
            if !classes.contains(&waiting.group.class.get()) {
                continue;
            }
            if let Some((_, left)) = passed.iter_mut().find(|(one, _)| waiting.is_of(one)) {
                if *left == 0 {
                    continue;
                }
                *left -= 1;
            } else if only_passed {
                continue;
            }
            texts += waiting.world.to_string().len() + waiting.user.as_ref().map_or(0, |user| user.len());
            if texts > MAX_TEXTS && !listed.is_empty() {
                break;
            }
            listed.push(*place);
        }
        listed
    }

    /// What a simulation server is told about the client at a place.
    pub(super) fn wish(&self, place: Place, now: u64) -> Option<Wish> {
        let waiting = self.waiting.get(&place)?;
        Some(Wish {
            ticket: place.number,
            waited: now.saturating_sub(place.since),
            address: waiting.address,
            user: waiting.user.as_deref().map(str::to_owned),
            world: Some(ProjectUrl::clone(&waiting.world)),
        })
    }

    /// For each client the progress that it has to hear now, if any. `doors` are those of each class.
    pub(super) fn news(&mut self, doors: &[Doors], now: Instant) -> Vec<(Client, Position)> {
        let mut news = Vec::new();
        let mut ahead = vec![0_u32; doors.len()];
        for (place, waiting) in &mut self.waiting {
            let class = waiting.group.class.get();
            let stands = progress(&self.classes, *place, class, &ahead, doors.get(class));
            if let Some(count) = ahead.get_mut(class) {
                *count += 1;
            }
            let is_due = |(heard, at): (Position, Instant)| {
                heard != stands && now.saturating_duration_since(at) >= INTERVAL.max(INTERVAL * stands.ahead / 100)
            };
            if waiting.heard.is_none_or(is_due) {
                waiting.heard = Some((stands, now));
                news.push((waiting.client.clone(), stands));
            }
        }
        news
    }

    /// How the clients stand that have heard nothing yet; none of them is before this place. Most of them are at the end
    /// of the line, so the others are counted from there. `doors` says those of a class.
    pub(super) fn first_news(
        &mut self,
        from: Place,
        mut doors: impl FnMut(&Classes<Server>, ClassId) -> Doors,
        now: Instant,
    ) -> Vec<(Client, Position)> {
        let mut news = Vec::new();
        let mut ahead: Vec<u32> = self.classes.iter().map(|class| class.waiting).collect();
        let mut known = HashMap::new();
        for (place, waiting) in self.waiting.range_mut(from..).rev() {
            let class = waiting.group.class.get();
            if let Some(count) = ahead.get_mut(class) {
                *count -= 1;
            }
            if waiting.heard.is_none() {
                let doors = known.entry(class).or_insert_with(|| doors(&self.classes, class));
                let stands = progress(&self.classes, *place, class, &ahead, Some(doors));
                waiting.heard = Some((stands, now));
                news.push((waiting.client.clone(), stands));
            }
        }
        news
    }

    /// The clients whose tickets must be sent again.
    pub(super) fn renewals(&mut self, now: Instant, after: Duration) -> Vec<(Client, Place)> {
        let mut due = Vec::new();
        for (place, waiting) in &mut self.waiting {
            if now.saturating_duration_since(waiting.ticket) >= after {
                waiting.ticket = now;
                due.push((waiting.client.clone(), *place));
            }
        }
        due
    }
}

impl<Client> Waiting<Client> {
    /// Whether it is one of these.
    pub(super) fn is_of(&self, passed: &PassedOver) -> bool {
        match passed {
            PassedOver::Address(address) => self.address == Some(*address),
            PassedOver::User(user) => self.user.as_deref() == Some(user),
        }
    }
}

/// How a client of a class stands, if `ahead` are those ahead of it by class.
fn progress<Server: Clone + Eq>(
    classes: &Classes<Server>,
    place: Place,
    class: ClassId,
    ahead: &[u32],
    doors: Option<&Doors>,
) -> Position {
    let of_line = classes.competing(class, ahead);
    let at_doors = doors.map_or(0, |doors| doors.queue.partition_point(|since| *since < place.since));
    let ahead = of_line.saturating_add(u32::try_from(at_doors).unwrap_or(u32::MAX));
    Position {
        ahead,
        estimate: doors.and_then(|doors| estimate(doors.basis, ahead)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::line::rate::Basis;
    use crate::shared::domain::Admission;

    fn entry(repository: &str, client: u32, user: Option<&str>) -> Entry<u32> {
        Entry {
            world: ProjectUrl::parse(&format!("https://github.com/{repository}/blob/main/worlds/a.wbt")).unwrap(),
            client,
            wait: client.into(),
            address: None,
            user: user.map(str::to_owned),
            label: None,
        }
    }

    fn place(since: u64, number: u64) -> Place {
        Place { since, number }
    }

    fn line() -> WaitingLine<u32, u32> {
        let mut line = WaitingLine::default();
        line.set_servers(&[0], takes_all);
        line
    }

    #[expect(
        clippy::unnecessary_wraps,
        clippy::trivially_copy_pass_by_ref,
        reason = "the terms of a server"
    )]
    fn takes_all(_: &u32, _: &ProjectUrl) -> Option<Terms> {
        Some(Terms {
            admission: Admission::Dedicated,
            is_open: true,
        })
    }

    fn clients(line: &WaitingLine<u32, u32>) -> Vec<u32> {
        line.iter().map(|(_, waiting)| waiting.client).collect()
    }

    #[test]
    fn a_ticket_and_a_user_have_one_place_each() {
        let now = Instant::now();
        let mut line = line();
        line.enter(place(10, 1), entry("lab/arm", 1, None), takes_all, now);
        line.enter(place(20, 2), entry("lab/arm", 2, Some("anna")), takes_all, now);
        line.enter(place(30, 3), entry("lab/leg", 3, None), takes_all, now);
        // The same ticket on another connection, before and after the first one has ended.
        assert_eq!(
            line.enter(place(10, 1), entry("lab/arm", 4, None), takes_all, now),
            (place(10, 1), vec![1])
        );
        line.leave(1);
        assert_eq!(clients(&line), [4, 2, 3]);
        // Another tab of the same user.
        assert_eq!(
            line.enter(place(40, 5), entry("lab/arm", 5, Some("anna")), takes_all, now),
            (place(20, 2), vec![2])
        );
        assert_eq!(clients(&line), [4, 5, 3]);
        // The same user with the ticket of somebody else: both are told.
        assert_eq!(
            line.enter(place(10, 1), entry("lab/arm", 6, Some("anna")), takes_all, now),
            (place(10, 1), vec![4, 5])
        );
        assert_eq!(clients(&line), [6, 3]);
        line.leave(4);
        line.leave(5);
        line.leave(6);
        line.leave(3);
        assert!(line.waiting.is_empty() && line.since.is_empty() && line.users.is_empty() && line.groups.is_empty());
        assert!(line.waits.is_empty() && line.classes.occupied() == 0);
    }

    #[test]
    fn one_who_comes_back_with_a_ticket_is_where_it_was() {
        let now = Instant::now();
        let mut line = line();
        line.enter(place(20, 2), entry("lab/arm", 2, None), takes_all, now);
        line.enter(place(30, 3), entry("lab/arm", 3, None), takes_all, now);
        line.enter(place(10, 1), entry("lab/arm", 1, None), takes_all, now);
        assert_eq!(clients(&line), [1, 2, 3]);
    }

    #[test]
    fn only_changes_are_heard_and_rarely_by_those_far_behind() {
        let start = Instant::now();
        let mut line = line();
        for number in 0..400 {
            line.enter(
                place(number, number),
                entry("lab/arm", number.try_into().unwrap(), None),
                takes_all,
                start,
            );
        }
        let mut heard = |at: f64, gone: u64| {
            for number in 0..gone {
                line.remove(place(number, number));
            }
            let doors = Doors {
                queue: Vec::new(),
                basis: Basis::default(),
            };
            line.news(&[doors], start + Duration::from_secs_f64(at)).len()
        };
        assert_eq!(heard(0.0, 0), 400, "each hears where it is");
        assert_eq!(heard(5.0, 0), 0, "nothing has changed");
        assert_eq!(heard(5.1, 1), 399, "whoever has moved hears it");
        assert_eq!(heard(5.9, 2), 0, "at most once a second");
        assert_eq!(heard(6.1, 2), 101, "those up to a hundred each second");
        assert_eq!(heard(7.1, 2), 100, "those up to two hundred every two");
        assert_eq!(heard(60.0, 2), 197, "the rest later");
        assert_eq!(heard(120.0, 2), 0, "nobody hears the same twice");
    }

    #[test]
    fn a_ticket_takes_less_than_a_kilobyte() {
        // A node of the tree, the indices and the parts on the heap, with long names and a URL.
        let texts = 60 + 60 + 150;
        let index = 2 * (size_of::<u64>() * 3 + size_of::<Arc<str>>() + 2 * size_of::<Place>() + 16);
        let entry = 2 * (size_of::<Place>() + size_of::<Waiting<actix::Recipient<Ping>>>());
        assert!(entry + index + texts < 1000, "{}", entry + index + texts);
    }

    #[derive(actix::Message)]
    #[rtype(result = "()")]
    struct Ping;
}
