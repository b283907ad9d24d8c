//! The simulations of all servers and the clients in the line, each with the number of its last change. So a page receives
//! what has changed since it was told last, whenever that was.
//!
//! The links to simulation servers write it from the thread of the monitors, and the routes read it, so a mutex guards it.

use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::join_all;
use parking_lot::Mutex;
use serde::Serialize;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::sync::{oneshot, watch};
use tokio::time::timeout;

use crate::shared::domain::{PublicAddress, RosterUpdate, ServerRun, SimulationReport, Stage};

/// Somebody of the class: a simulation, or a client that waits in the line. Times are in seconds since 1970.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct ClassEntry {
    /// The simulation's id; unique on its server. That of a client that waits begins with `waiting-`.
    pub id: String,
    /// The simulation server; none for a client that waits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server: Option<PublicAddress>,
    /// The URL of the world.
    pub world: String,
    /// The user whom a trusted reverse proxy names.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// The name that the client has chosen; it is not checked.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<String>,
    /// The state.
    pub state: ClassState,
    /// When the client came.
    pub since: u64,
    /// Seconds for which the client has waited for its slot.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub waited: Option<f64>,
    /// Until when the simulation waits for its disconnected client.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub away_until: Option<u64>,
    /// Percent of one core, rounded; only while somebody has the page of the class open.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu: Option<u32>,
    /// Simulated seconds per second, in percent, rounded; only if the stream is relayed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub real_time: Option<u32>,
}

/// The state of somebody of the class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ClassState {
    /// In the line of the session server.
    Waiting,
    /// That of a simulation.
    #[serde(untagged)]
    Simulation(Stage),
}

/// What identifies an entry: its server, and its id there.
pub type Key = (Option<PublicAddress>, String);

/// What has changed since a version.
#[derive(Debug, Clone, PartialEq)]
pub struct Changes {
    /// The version that this leads to.
    pub version: u64,
    /// Whether `changed` is all, and replaces what was known before.
    pub all: bool,
    /// The entries that are new, or have changed.
    pub changed: Vec<ClassEntry>,
    /// The entries that are gone.
    pub gone: Vec<Key>,
}

/// Which simulations are meant. Each condition that is given must hold.
#[derive(Debug, Clone, Default)]
pub struct Matching {
    /// They have one of these ids.
    pub ids: Option<Vec<String>>,
    /// They have this world.
    pub world: Option<String>,
    /// They run on this server.
    pub server: Option<String>,
    /// They are this user's.
    pub user: Option<String>,
    /// Their client has chosen this name.
    pub label: Option<String>,
}

/// Stops simulations of one server.
#[derive(Debug)]
pub struct StopRequest {
    /// Their ids.
    pub ids: Vec<String>,
    /// The reason for their clients.
    pub reason: String,
    /// Who stops them, for the log.
    pub by: String,
    /// Receives the ids of those that are being stopped.
    pub done: oneshot::Sender<Vec<String>>,
}

/// The list.
#[derive(Debug, Default)]
pub struct Roster {
    list: Mutex<List>,
    /// Number of pages that show the list.
    watching: watch::Sender<usize>,
}

#[derive(Debug, Default)]
struct List {
    version: u64,
    entries: BTreeMap<Key, (u64, ClassEntry)>,
    /// The last entries that are gone, each with its version.
    gone: VecDeque<(u64, Key)>,
    /// The version before the first of these.
    gone_since: u64,
    /// The links to simulation servers.
    links: HashMap<PublicAddress, Link>,
}

/// A simulation server that tells its simulations.
#[derive(Debug)]
struct Link {
    run: ServerRun,
    requests: UnboundedSender<StopRequest>,
}

/// A page that shows the list, until this is dropped.
#[derive(Debug)]
pub struct Watching(watch::Sender<usize>);

/// A simulation server tells of more simulations than it can have, or its texts are too long.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("its list of simulations exceeds {} MiB, or an id in it {LONGEST_ID} bytes", MAX_OF_SERVER >> 20)]
pub struct RosterTooLarge;

/// Most bytes that the entries of one server take; those of a simulation for each port take less.
const MAX_OF_SERVER: usize = 64 << 20;
/// Longest id of a simulation, in bytes; those of our servers have about 25.
const LONGEST_ID: usize = 100;
/// Number of entries that are gone and known as such.
const GONE: usize = 10_000;
/// Most ids in one order.
const PER_ORDER: usize = 100;
/// Timeout of an order.
const ANSWER: Duration = Duration::from_secs(5);

impl Roster {
    /// A simulation server tells its simulations from now on. Returns what it must do, as long as it does.
    pub fn link(&self, server: PublicAddress, run: ServerRun) -> UnboundedReceiver<StopRequest> {
        let (sender, requests) = unbounded_channel();
        let link = Link { run, requests: sender };
        self.list.lock().links.insert(server, link);
        requests
    }

    /// A simulation server whose requests nobody receives any more tells its simulations no longer. Another link to it may
    /// have begun meanwhile.
    pub fn unlink(&self, server: &PublicAddress) {
        let mut list = self.list.lock();
        if list.links.get(server).is_some_and(|link| link.requests.is_closed()) {
            list.links.remove(server);
            list.remove_all(Some(server));
        }
    }

    /// Whether a simulation server tells its simulations.
    pub fn is_linked(&self, server: &PublicAddress) -> bool {
        self.list.lock().links.contains_key(server)
    }

    /// The run of a simulation server that tells its simulations, by its own word. `None` if another one tells the same: it
    /// is listed twice, or one of them lies.
    pub fn run_of(&self, server: &PublicAddress) -> Option<ServerRun> {
        let list = self.list.lock();
        let run = list.links.get(server)?.run;
        let tell_it = list.links.values().filter(|link| link.run == run);
        (tell_it.count() == 1).then_some(run)
    }

    /// Adds what a simulation server has told.
    ///
    /// # Errors
    /// When it has told too much. Its link must end then, with which its entries go.
    pub fn update(&self, server: &PublicAddress, update: RosterUpdate) -> Result<(), RosterTooLarge> {
        let mut list = self.list.lock();
        // Of a link that has ended.
        if !list.links.contains_key(server) {
            return Ok(());
        }
        // Those that are gone are known for a while.
        if update.simulations.iter().any(|one| one.id.len() > LONGEST_ID) {
            return Err(RosterTooLarge);
        }
        if update.all {
            let told: HashSet<&String> = update.simulations.iter().map(|one| &one.id).collect();
            list.retain(Some(server), |id| told.contains(id));
        }
        for id in update.ended {
            list.remove((Some(server.clone()), id));
        }
        for simulation in update.simulations {
            list.put(entry(server, simulation));
        }
        let sizes = list.entries_of(Some(server)).map(|(_, (_, entry))| entry.size());
        if sizes.sum::<usize>() > MAX_OF_SERVER {
            return Err(RosterTooLarge);
        }
        Ok(())
    }

    /// These clients wait in the line, and no others.
    pub fn set_waiting(&self, waiting: Vec<ClassEntry>) {
        let mut list = self.list.lock();
        let ids: HashSet<&String> = waiting.iter().map(|one| &one.id).collect();
        list.retain(None, |id| ids.contains(id));
        for one in waiting {
            list.put(one);
        }
    }

    /// The version of the list, which changes with it.
    pub fn version(&self) -> u64 {
        self.list.lock().version
    }

    /// All entries.
    pub fn all(&self) -> Vec<ClassEntry> {
        let list = self.list.lock();
        list.entries.values().map(|(_, entry)| entry.clone()).collect()
    }

    /// What has changed since a version; without one, or if that is too long ago, all.
    pub fn since(&self, version: Option<u64>) -> Changes {
        let list = self.list.lock();
        let known = version.filter(|version| (list.gone_since..=list.version).contains(version));
        let is_new = |at: u64| known.is_none_or(|known| at > known);
        let changed = list.entries.values().filter(|(at, _)| is_new(*at));
        let gone = list.gone.iter().filter(|(at, _)| known.is_some() && is_new(*at));
        Changes {
            version: list.version,
            all: known.is_none(),
            changed: changed.map(|(_, entry)| entry.clone()).collect(),
            gone: gone
                .map(|(_, key)| key.clone())
                .filter(|key| !list.entries.contains_key(key))
                .collect(),
        }
    }

    /// The servers of the simulations with this id: seldom more than one.
    pub fn servers_of(&self, id: &str) -> Vec<PublicAddress> {
        let list = self.list.lock();
        let with_id = list.entries.keys().filter(|(_, one)| one == id);
        with_id.filter_map(|(of, _)| of.clone()).collect()
    }

    /// The server of the simulation with this id; `server` tells it from those of others with the same id.
    pub fn server_of(&self, id: &str, server: Option<&str>) -> Option<PublicAddress> {
        let is_it = |of: &PublicAddress| server.is_none_or(|server| of.to_string() == server);
        self.servers_of(id).into_iter().find(is_it)
    }

    /// A page shows the list from now on.
    pub fn watch(&self) -> Watching {
        self.watching.send_modify(|count| *count += 1);
        Watching(self.watching.clone())
    }

    /// The number of pages that show the list.
    pub fn watching(&self) -> watch::Receiver<usize> {
        self.watching.subscribe()
    }

    /// Stops simulations. Returns the ids of those that are being stopped, and of those that are not, because they have
    /// ended or their server does not answer.
    pub async fn stop(self: &Arc<Self>, which: &Matching, reason: &str, by: &str) -> (Vec<String>, Vec<String>) {
        let chosen = self.list.lock().chosen(which);
        let wanted: Vec<String> = match &which.ids {
            Some(ids) => ids.clone(),
            None => chosen.values().flatten().cloned().collect(),
        };
        let orders = chosen.into_iter().flat_map(|(server, ids)| {
            let orders = ids.chunks(PER_ORDER).map(<[String]>::to_vec);
            orders
                .map(|ids| self.order(&server, ids, reason, by))
                .collect::<Vec<_>>()
        });
        let orders = orders.collect::<Vec<_>>();
        let stopped: Vec<String> = join_all(orders).await.into_iter().flatten().collect();
        let done: HashSet<&String> = stopped.iter().collect();
        let failed = wanted.into_iter().filter(|id| !done.contains(id)).collect();
        (stopped, failed)
    }

    /// Sends an order to a server; returns what it has stopped.
    fn order(
        &self,
        server: &PublicAddress,
        ids: Vec<String>,
        reason: &str,
        by: &str,
    ) -> impl Future<Output = Vec<String>> + use<> {
        let (done, answer) = oneshot::channel();
        let request = StopRequest {
            ids,
            reason: reason.to_owned(),
            by: by.to_owned(),
            done,
        };
        if let Some(link) = self.list.lock().links.get(server) {
            // The link may have ended; then nobody answers.
            link.requests.send(request).ok();
        }
        async {
            timeout(ANSWER, answer)
                .await
                .ok()
                .and_then(Result::ok)
                .unwrap_or_default()
        }
    }
}

impl List {
    /// Adds an entry, or replaces it if it has changed.
    fn put(&mut self, entry: ClassEntry) {
        let key = (entry.server.clone(), entry.id.clone());
        if self.entries.get(&key).is_some_and(|(_, known)| *known == entry) {
            return;
        }
        self.version += 1;
        self.entries.insert(key, (self.version, entry));
    }

    fn remove(&mut self, key: Key) {
        if self.entries.remove(&key).is_none() {
            return;
        }
        self.version += 1;
        if self.gone.len() == GONE
            && let Some((version, _)) = self.gone.pop_front()
        {
            self.gone_since = version;
        }
        self.gone.push_back((self.version, key));
    }

    fn remove_all(&mut self, server: Option<&PublicAddress>) {
        self.retain(server, |_| false);
    }

    /// The entries of a server, or of the line.
    fn entries_of(&self, server: Option<&PublicAddress>) -> impl Iterator<Item = (&Key, &(u64, ClassEntry))> {
        let first = (server.cloned(), String::new());
        let is_of = move |((of, _), _): &(&Key, _)| of.as_ref() == server;
        self.entries.range(first..).take_while(is_of)
    }

    /// Removes the entries of a server, or of the line, whose ids don't stay.
    fn retain(&mut self, server: Option<&PublicAddress>, stays: impl Fn(&String) -> bool) {
        let known = self.entries_of(server).map(|(key, _)| key);
        let gone: Vec<Key> = known.filter(|(_, id)| !stays(id)).cloned().collect();
        for key in gone {
            self.remove(key);
        }
    }

    /// The ids of the simulations that are meant, by their servers.
    fn chosen(&self, which: &Matching) -> HashMap<PublicAddress, Vec<String>> {
        let mut chosen: HashMap<PublicAddress, Vec<String>> = HashMap::new();
        for (_, entry) in self.entries.values().filter(|(_, entry)| which.matches(entry)) {
            if let Some(server) = &entry.server {
                chosen.entry(server.clone()).or_default().push(entry.id.clone());
            }
        }
        chosen
    }
}

impl ClassEntry {
    /// The bytes that it takes.
    fn size(&self) -> usize {
        let optional = [&self.user, &self.label].into_iter().flatten();
        let texts = [&self.id, &self.world].into_iter().chain(optional);
        size_of::<Self>() + texts.map(String::len).sum::<usize>()
    }
}

impl Matching {
    /// Whether no condition is given, which would mean all.
    pub fn is_empty(&self) -> bool {
        let Self {
            ids,
            world,
            server,
            user,
            label,
        } = self;
        ids.is_none() && [world, server, user, label].iter().all(|one| one.is_none())
    }

    fn matches(&self, entry: &ClassEntry) -> bool {
        let is =
            |wanted: &Option<String>, value: Option<&str>| wanted.as_deref().is_none_or(|wanted| value == Some(wanted));
        let server = entry.server.as_ref().map(ToString::to_string);
        self.ids.as_ref().is_none_or(|ids| ids.contains(&entry.id))
            && is(&self.world, Some(&entry.world))
            && is(&self.server, server.as_deref())
            && is(&self.user, entry.user.as_deref())
            && is(&self.label, entry.label.as_deref())
    }
}

impl Drop for Watching {
    fn drop(&mut self) {
        self.0.send_modify(|count| *count -= 1);
    }
}

fn entry(server: &PublicAddress, simulation: SimulationReport) -> ClassEntry {
    ClassEntry {
        id: simulation.id,
        server: Some(server.clone()),
        world: simulation.world,
        user: simulation.user,
        label: simulation.label,
        state: ClassState::Simulation(simulation.state),
        since: simulation.since,
        waited: simulation.waited,
        away_until: simulation.away_until,
        cpu: simulation.cpu,
        real_time: simulation.real_time,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn simulation(id: &str, state: Stage) -> SimulationReport {
        SimulationReport {
            id: id.to_owned(),
            world: "https://github.com/lab/arm/blob/main/worlds/a.wbt".to_owned(),
            user: None,
            label: Some("Nora 14".to_owned()),
            state,
            since: 1,
            waited: None,
            away_until: None,
            cpu: None,
            real_time: None,
        }
    }

    fn update(all: bool, simulations: Vec<SimulationReport>, ended: &[&str]) -> RosterUpdate {
        RosterUpdate {
            all,
            simulations,
            ended: ended.iter().map(|id| (*id).to_owned()).collect(),
        }
    }

    #[test]
    fn one_change_costs_one_entry() {
        let roster = Roster::default();
        let server: PublicAddress = "host:2000".parse().unwrap();
        let other: PublicAddress = "host:2001".parse().unwrap();
        let _link = roster.link(server.clone(), ServerRun(1));
        let before = roster.link(other.clone(), ServerRun(1));
        let mut link = roster.link(other.clone(), ServerRun(1));
        drop(before);
        roster.unlink(&other);
        assert!(roster.is_linked(&other), "another link has begun");
        let three = ["1", "2", "3"].map(|id| simulation(id, Stage::Launching)).to_vec();
        roster.update(&server, update(true, three.clone(), &[])).unwrap();
        roster.update(&other, update(true, three.clone(), &[])).unwrap();
        let first = roster.since(None);
        assert_eq!((first.all, first.changed.len(), first.gone.len()), (true, 6, 0));
        // What has not changed costs nothing.
        roster.update(&server, update(true, three, &[])).unwrap();
        assert_eq!(roster.since(Some(first.version)).version, first.version);
        roster
            .update(&server, update(false, vec![simulation("2", Stage::Running)], &[]))
            .unwrap();
        let second = roster.since(Some(first.version));
        assert_eq!((second.all, second.changed.len(), second.gone.len()), (false, 1, 0));
        roster.update(&server, update(false, vec![], &["2", "9"])).unwrap();
        let third = roster.since(Some(second.version));
        assert_eq!(third.changed, []);
        assert_eq!(third.gone, [(Some(server.clone()), "2".to_owned())]);
        // A server whose link has ended.
        link.close();
        roster.unlink(&other);
        assert_eq!(roster.since(Some(third.version)).gone.len(), 3);
        assert_eq!(roster.all().len(), 2);
        roster
            .update(&other, update(true, vec![simulation("1", Stage::Running)], &[]))
            .unwrap();
        assert_eq!(roster.all().len(), 2, "a message that is late");
        // One who knows an old version, or that of another run.
        assert!(roster.since(Some(10_000)).all);
    }

    #[test]
    fn a_run_that_two_servers_tell_is_neithers() {
        let roster = Roster::default();
        let [first, second] = ["host:2000", "host:2001"].map(|server| server.parse::<PublicAddress>().unwrap());
        let _first = roster.link(first.clone(), ServerRun(1));
        assert_eq!(
            (roster.run_of(&first), roster.run_of(&second)),
            (Some(ServerRun(1)), None)
        );
        let _second = roster.link(second.clone(), ServerRun(1));
        assert_eq!((roster.run_of(&first), roster.run_of(&second)), (None, None));
    }

    #[test]
    fn who_is_gone_for_long_is_forgotten() {
        let roster = Roster::default();
        let server: PublicAddress = "host:2000".parse().unwrap();
        let _link = roster.link(server.clone(), ServerRun(1));
        for number in 0..GONE + 10 {
            let id = number.to_string();
            roster
                .update(&server, update(false, vec![simulation(&id, Stage::Running)], &[]))
                .unwrap();
            roster.update(&server, update(false, vec![], &[&id])).unwrap();
        }
        assert!(roster.since(Some(1)).all, "it can't be told what is gone");
        let last = roster.since(Some(roster.version() - 2));
        assert_eq!((last.all, last.gone.len()), (false, 1));
    }

    #[test]
    fn a_server_that_tells_of_too_many_fills_no_memory() {
        let roster = Roster::default();
        let server: PublicAddress = "host:2000".parse().unwrap();
        let other: PublicAddress = "host:2001".parse().unwrap();
        let links = [&server, &other].map(|server| roster.link(server.clone(), ServerRun(1)));
        let one = |id: usize, world: usize| SimulationReport {
            world: "x".repeat(world),
            ..simulation(&id.to_string(), Stage::Running)
        };
        let long = [simulation(&"1".repeat(LONGEST_ID + 1), Stage::Running)];
        assert_eq!(
            roster.update(&server, update(true, long.to_vec(), &[])),
            Err(RosterTooLarge)
        );
        let every_port = (0..usize::from(u16::MAX)).map(|id| one(id, 100)).collect();
        assert_eq!(roster.update(&other, update(true, every_port, &[])), Ok(()));
        let mut told = 0;
        while roster
            .update(&server, update(false, vec![one(told, 500_000)], &[]))
            .is_ok()
        {
            told += 1;
            assert!(told < 1000);
        }
        drop(links);
        roster.unlink(&server);
        assert_eq!(roster.all().len(), usize::from(u16::MAX));
    }

    #[test]
    fn a_simulation_is_told_from_one_with_its_id_at_another_server() {
        let roster = Roster::default();
        let servers: [PublicAddress; 2] = ["host:2000", "host:2001"].map(|server| server.parse().unwrap());
        let _links = servers
            .each_ref()
            .map(|server| roster.link(server.clone(), ServerRun(1)));
        for server in &servers {
            let list = vec![simulation("1", Stage::Running)];
            roster.update(server, update(true, list, &[])).unwrap();
        }
        for server in &servers {
            let found = roster.server_of("1", Some(&server.to_string()));
            assert_eq!(found.as_ref(), Some(server));
        }
        assert!(roster.server_of("1", None).is_some());
        assert_eq!(roster.server_of("1", Some("host:2002")), None);
    }

    #[test]
    fn conditions_choose_simulations() {
        let one = entry(&"host:2000".parse().unwrap(), simulation("1", Stage::Running));
        let world = |world: &str| Matching {
            world: Some(world.to_owned()),
            ..Matching::default()
        };
        assert!(world(&one.world).matches(&one) && !world("x").matches(&one));
        let both = Matching {
            label: Some("Nora 1".to_owned()),
            ..world(&one.world)
        };
        assert!(!both.matches(&one));
        let user = Matching {
            user: Some("Nora 14".to_owned()),
            ..Matching::default()
        };
        assert!(!user.matches(&one), "a name that is not checked is no user");
        assert!(Matching::default().is_empty() && !user.is_empty());
    }
}
