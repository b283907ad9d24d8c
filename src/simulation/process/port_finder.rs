//! Finds the ports on which starting simulations listen: one thread, and one kernel query for all of them.
//!
//! The thread sleeps while nothing starts.

use std::collections::HashSet;
use std::io;
use std::ops::RangeInclusive;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::listeners::{Listener, listeners};
use super::process_tree::{sockets, tree};

/// Finds ports. The thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub struct PortFinder(Sender<Search>);

/// A process whose port is searched for.
#[derive(Debug)]
struct Search {
    root: i32,
    ports: RangeInclusive<u16>,
    since: Instant,
    /// The candidates of earlier walks of its tree, none of which were its own, and the time of the last walk.
    foreign: HashSet<u64>,
    walked: Instant,
    found: Option<oneshot::Sender<u16>>,
}

/// The pause between two queries, as a fraction (1/16) of the age of the youngest search.
const PART: u32 = 16;
/// The shortest pause; it delays a start by half of it on average.
const SHORTEST: Duration = Duration::from_millis(4);
/// Least pause as a multiple of the duration of a query, so that a class that starts leaves the cores to Webots.
const QUERIES: u32 = 15;
/// The longest pause.
const LONGEST: Duration = Duration::from_millis(200);
/// Interval between two walks of a tree without new listeners: `/proc` may omit a child while others start and exit.
const WALK_AGAIN: Duration = Duration::from_secs(1);

impl PortFinder {
    /// Starts the thread. `ports` contain the ranges of all searches.
    ///
    /// # Errors
    /// When the system can't start a thread.
    pub fn start(ports: RangeInclusive<u16>) -> io::Result<Self> {
        let (sender, receiver) = channel();
        std::thread::Builder::new().name("ports".to_owned()).spawn(move || run(&receiver, &ports))?;
        Ok(Self(sender))
    }

    /// Waits until a process that descends from `root` listens on a port of a range, and returns the port. Listeners of
    /// other processes are ignored. Never returns if there is none: the caller sets a timeout.
    pub async fn find(&self, root: i32, ports: RangeInclusive<u16>) -> u16 {
        let (sender, found) = oneshot::channel();
        let now = Instant::now();
        let search = Search { root, ports, since: now, foreign: HashSet::new(), walked: now, found: Some(sender) };
        // The thread runs until the last sender is dropped.
        self.0.send(search).ok();
        match found.await {
            Ok(port) => port,
            Err(_) => std::future::pending().await,
        }
    }
}

/// Serves searches until the last sender is dropped.
fn run(searches: &Receiver<Search>, ports: &RangeInclusive<u16>) {
    let mut open: Vec<Search> = Vec::new();
    let mut owned = HashSet::new();
    let mut pause = Duration::ZERO;
    loop {
        // A new search ends a long pause.
        let next = if open.is_empty() { searches.recv().ok() } else { searches.recv_timeout(pause).ok() };
        match next {
            Some(search) => open.push(search),
            None if open.is_empty() => return,
            None => {}
        }
        open.extend(searches.try_iter());
        let begin = Instant::now();
        if let Err(error) = look(&mut open, &mut owned, ports) {
            log::warn!("the system does not tell which ports are listened on: {error}");
        }
        open.retain(|search| search.found.as_ref().is_some_and(|found| !found.is_closed()));
        let least = (begin.elapsed() * QUERIES).clamp(SHORTEST, LONGEST);
        let age = open.iter().map(|search| search.since.elapsed()).min().unwrap_or_default();
        if !open.is_empty() {
            std::thread::sleep(least);
        }
        pause = (age / PART).min(LONGEST).saturating_sub(least);
    }
}

/// Queries the kernel once for all searches. `owned` are the listeners that were found so far.
fn look(open: &mut [Search], owned: &mut HashSet<u64>, ports: &RangeInclusive<u16>) -> io::Result<()> {
    let all = listeners(ports)?;
    let there: HashSet<u64> = all.iter().map(|one| one.inode).collect();
    owned.retain(|inode| there.contains(inode));
    // First only the requested port of each search, so that none of several concurrent starts claims the listener of
    // another.
    for is_first in [true, false] {
        for search in open.iter_mut() {
            let (first, last) = (*search.ports.start(), *search.ports.end());
            let listeners = listeners_in(&all, first..=if is_first { first } else { last });
            let candidates: Vec<Listener> = listeners.filter(|one| !owned.contains(&one.inode)).copied().collect();
            if let Some(Listener { port, inode }) = search.own(&candidates)
                && let Some(found) = search.found.take()
            {
                owned.insert(inode);
                // The receiver may have been dropped.
                found.send(port).ok();
            }
        }
    }
    Ok(())
}

/// The listeners of a range, in a list that is sorted by port.
fn listeners_in(all: &[Listener], ports: RangeInclusive<u16>) -> impl Iterator<Item = &Listener> {
    let begin = all.partition_point(|one| one.port < *ports.start());
    all.get(begin..).unwrap_or_default().iter().take_while(move |one| ports.contains(&one.port))
}

impl Search {
    /// The first of these listeners that belongs to a process of the tree. The tree is walked only if a listener is new.
    fn own(&mut self, candidates: &[Listener]) -> Option<Listener> {
        let is_foreign = candidates.iter().all(|one| self.foreign.contains(&one.inode));
        if self.found.is_none() || candidates.is_empty() || (is_foreign && self.walked.elapsed() < WALK_AGAIN) {
            return None;
        }
        let own: HashSet<u64> = tree(self.root).into_iter().flat_map(sockets).collect();
        self.walked = Instant::now();
        self.foreign.extend(candidates.iter().map(|one| one.inode));
        candidates.iter().find(|one| own.contains(&one.inode)).copied()
    }
}
