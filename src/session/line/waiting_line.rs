//! Who waits, in the order of arrival.

use std::collections::{BTreeMap, HashMap};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::shared::domain::{ProjectUrl, Wish};

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
    /// Identifies its connection: it may come back on another one before the first has ended.
    pub connection: u64,
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
pub struct Progress {
    /// Number of clients ahead that the same servers could take.
    pub ahead: u32,
    /// Seconds until its turn, as far as that can be estimated.
    pub estimate: Option<u32>,
}

/// The worlds of one repository: each server accepts all of them, or none.
#[derive(Debug)]
pub(super) struct Group {
    /// One of its worlds.
    pub(super) world: ProjectUrl,
    repository: String,
}

/// A client in the line.
#[derive(Debug)]
pub(super) struct Waiting<Client> {
    label: Option<Box<str>>,
    pub(super) group: Arc<Group>,
    pub(super) world: ProjectUrl,
    pub(super) client: Client,
    connection: u64,
    address: Option<IpAddr>,
    user: Option<Arc<str>>,
    /// What it heard last, and when.
    heard: Option<(Progress, Instant)>,
    /// When its ticket was sent last.
    ticket: Instant,
}

/// The clients that wait. Everything about one of them is in one entry, and in the indices by number and user.
#[derive(Debug)]
pub(super) struct WaitingLine<Client> {
    waiting: BTreeMap<Place, Waiting<Client>>,
    since: HashMap<u64, u64>,
    users: HashMap<Arc<str>, Place>,
    /// The groups of those who wait, each with the number of them.
    groups: HashMap<String, (Arc<Group>, u32)>,
}

impl<Client> Default for WaitingLine<Client> {
    fn default() -> Self {
        Self {
            waiting: BTreeMap::new(),
            since: HashMap::new(),
            users: HashMap::new(),
            groups: HashMap::new(),
        }
    }
}

/// Shortest interval between two positions of a client. That of a client with more than a hundred ahead grows with its
/// position, so that a long line costs no more than a short one.
const INTERVAL: Duration = Duration::from_secs(1);

impl<Client: Clone> WaitingLine<Client> {
    /// Adds a client at a place. If its ticket or its user has a place already, the client takes that over: it gets the
    /// earlier one of the two. Returns its place, and the client that has lost it.
    pub(super) fn enter(&mut self, place: Place, entry: Entry<Client>, now: Instant) -> (Place, Option<Client>) {
        let user: Option<Arc<str>> = entry.user.map(Arc::from);
        let of_user = user.as_ref().and_then(|user| self.users.get(user)).copied();
        let of_ticket = self.place_of(place.number);
        let mut displaced = None;
        let mut first = place;
        for before in [of_ticket, of_user].into_iter().flatten() {
            first = first.min(before);
            displaced = self.remove(before).map(|waiting| waiting.client).or(displaced);
        }
        let repository = entry.world.repository().to_lowercase();
        let (group, count) = self.groups.entry(repository.clone()).or_insert_with(|| {
            let world = entry.world.clone();
            (Arc::new(Group { world, repository }), 0)
        });
        *count += 1;
        let waiting = Waiting {
            label: entry.label.map(String::into_boxed_str),
            group: Arc::clone(group),
            world: entry.world,
            client: entry.client,
            connection: entry.connection,
            address: entry.address,
            user: user.clone(),
            heard: None,
            ticket: now,
        };
        self.since.insert(first.number, first.since);
        if let Some(user) = user {
            self.users.insert(user, first);
        }
        self.waiting.insert(first, waiting);
        (first, displaced)
    }

    /// Removes the client of a connection from its place. Another connection may have that place by now.
    pub(super) fn leave(&mut self, place: Place, connection: u64) {
        if self
            .waiting
            .get(&place)
            .is_some_and(|waiting| waiting.connection == connection)
        {
            self.remove(place);
        }
    }

    /// Removes the client at a place.
    pub(super) fn remove(&mut self, place: Place) -> Option<Waiting<Client>> {
        let waiting = self.waiting.remove(&place)?;
        self.since.remove(&place.number);
        if let Some(user) = &waiting.user {
            self.users.remove(user);
        }
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

    /// The groups of those who wait, each with the number of them.
    pub(super) fn groups(&self) -> impl Iterator<Item = (&Arc<Group>, u32)> {
        self.groups.values().map(|(group, count)| (group, *count))
    }

    /// Number of those who wait.
    pub(super) fn len(&self) -> usize {
        self.waiting.len()
    }

    /// What a simulation server is told about the client at a place.
    pub(super) fn wish(&self, place: Place, now: u64) -> Option<Wish> {
        let waiting = self.waiting.get(&place)?;
        Some(Wish {
            ticket: place.number,
            waited: now.saturating_sub(place.since),
            address: waiting.address,
            user: waiting.user.as_deref().map(str::to_owned),
            world: Some(waiting.world.clone()),
        })
    }

    /// For each client the progress that it has to hear now, if any. `progress` says how a client stands; it is called
    /// in the order of the line.
    pub(super) fn news(
        &mut self,
        now: Instant,
        mut progress: impl FnMut(&Place, &Arc<Group>) -> Progress,
    ) -> Vec<(Client, Progress)> {
        let mut news = Vec::new();
        for (place, waiting) in &mut self.waiting {
            let stands = progress(place, &waiting.group);
            let is_due = |(heard, at): (Progress, Instant)| {
                heard != stands && now.saturating_duration_since(at) >= INTERVAL.max(INTERVAL * stands.ahead / 100)
            };
            if waiting.heard.is_none_or(is_due) {
                waiting.heard = Some((stands, now));
                news.push((waiting.client.clone(), stands));
            }
        }
        news
    }

    /// How a client stands that has just come, as the first that it hears; `None` if it does not wait.
    pub(super) fn first_news(
        &mut self,
        place: Place,
        now: Instant,
        mut progress: impl FnMut(&Place, &Arc<Group>) -> Progress,
    ) -> Option<Progress> {
        let mut stands = None;
        for (before, waiting) in self.waiting.range(..=place) {
            stands = Some(progress(before, &waiting.group));
        }
        let waiting = self.waiting.get_mut(&place)?;
        waiting.heard = stands.map(|stands| (stands, now));
        stands
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

impl Group {
    /// The repository, in lower case.
    pub(super) fn repository(&self) -> &str {
        &self.repository
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(repository: &str, client: u32, user: Option<&str>) -> Entry<u32> {
        Entry {
            world: ProjectUrl::parse(&format!("https://github.com/{repository}/blob/main/worlds/a.wbt")).unwrap(),
            client,
            connection: client.into(),
            address: None,
            user: user.map(str::to_owned),
            label: None,
        }
    }

    fn place(since: u64, number: u64) -> Place {
        Place { since, number }
    }

    fn clients(line: &WaitingLine<u32>) -> Vec<u32> {
        line.iter().map(|(_, waiting)| waiting.client).collect()
    }

    #[test]
    fn a_ticket_and_a_user_have_one_place_each() {
        let now = Instant::now();
        let mut line = WaitingLine::default();
        line.enter(place(10, 1), entry("lab/arm", 1, None), now);
        line.enter(place(20, 2), entry("lab/arm", 2, Some("anna")), now);
        line.enter(place(30, 3), entry("lab/leg", 3, None), now);
        // The same ticket on another connection, before and after the first one has ended.
        assert_eq!(
            line.enter(place(10, 1), entry("lab/arm", 4, None), now),
            (place(10, 1), Some(1))
        );
        line.leave(place(10, 1), 1);
        assert_eq!(clients(&line), [4, 2, 3]);
        // Another tab of the same user.
        assert_eq!(
            line.enter(place(40, 5), entry("lab/arm", 5, Some("anna")), now),
            (place(20, 2), Some(2))
        );
        assert_eq!(clients(&line), [4, 5, 3]);
        line.leave(place(10, 1), 4);
        line.leave(place(20, 2), 5);
        line.leave(place(30, 3), 3);
        assert!(line.waiting.is_empty() && line.since.is_empty() && line.users.is_empty() && line.groups.is_empty());
    }

    #[test]
    fn one_who_comes_back_with_a_ticket_is_where_it_was() {
        let now = Instant::now();
        let mut line = WaitingLine::default();
        line.enter(place(20, 2), entry("lab/arm", 2, None), now);
        line.enter(place(30, 3), entry("lab/arm", 3, None), now);
        line.enter(place(10, 1), entry("lab/arm", 1, None), now);
        assert_eq!(clients(&line), [1, 2, 3]);
    }

    #[test]
    fn only_changes_are_heard_and_rarely_by_those_far_behind() {
        let start = Instant::now();
        let mut line = WaitingLine::default();
        for number in 0..400 {
            line.enter(
                place(number, number),
                entry("lab/arm", number.try_into().unwrap(), None),
                start,
            );
        }
        let mut heard = |at: f64, gone: u32| {
            let mut ahead = 0;
            let news = line.news(start + Duration::from_secs_f64(at), |_, _| {
                ahead += 1;
                let ahead = (ahead - 1_u32).saturating_sub(gone);
                Progress { ahead, estimate: None }
            });
            news.len()
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
        let index = 2 * (size_of::<u64>() * 2 + size_of::<Arc<str>>() + size_of::<Place>() + 16);
        let entry = 2 * (size_of::<Place>() + size_of::<Waiting<actix::Recipient<Ping>>>());
        assert!(entry + index + texts < 900, "{}", entry + index + texts);
    }

    #[derive(actix::Message)]
    #[rtype(result = "()")]
    struct Ping;
}
