//! Actor: keeps as many simulations ready as are asked for.
//!
//! One for the whole server, created at start; it never ends. Twice a second it compares what is asked for (key `ready`,
//! session servers) with what the slot pool has, and starts or ends simulations. The pool is the only record of them, so
//! that none is started twice. Every `timing.branches` it asks each remote whether branches have moved: then simulations
//! are replaced one at a time, each new one before an old one. It takes nothing from clients: it starts none while a
//! client waits or the load is high, and ends some while memory is scarce.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::fut::wrap_future;
use actix::prelude::*;
use actix_rt::task::spawn_blocking;
use jiff::Timestamp;

use super::session::{Session, SpareEvent};
use crate::shared::domain::{Failure, Load, ProjectUrl};
use crate::simulation::checkout::{KeptRepository, Tip, Tips};
use crate::simulation::container::ImageUse;
use crate::simulation::isolation::RepositoryAssets;
use crate::simulation::machine::Readings;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::slots::{SpareKind, SpareStatus};
use crate::simulation::state::AppState;

/// The actor.
pub struct SpareKeeper {
    server: Arc<AppState>,
    repositories: HashMap<String, ListedRepository>,
    worlds: BTreeMap<SpareKind, ListedWorld>,
    /// The number of clients that have come, and when that was seen to change.
    arrivals: (u64, Option<Instant>),
}

/// A repository of listed worlds.
#[derive(Default)]
struct ListedRepository {
    /// When its remote was asked last; `None` if it is to be asked at once.
    asked: Option<Instant>,
    /// Whether that had no result.
    is_failing: bool,
    /// What stays in the caches as long as it is listed.
    kept: Option<(KeptRepository, Option<Arc<RepositoryAssets>>)>,
}

/// A listed world.
#[derive(Default)]
struct ListedWorld {
    /// Whether its remote is asked about it, at first or again.
    is_asked: bool,
    /// The commit that its URL means, as the remote has said last.
    tip: Option<Tip>,
    failures: Option<Failures>,
    /// The images of the last one that was ready, which stay as long as the world is listed.
    images: Vec<ImageUse>,
}

/// Starts of a world that have failed.
struct Failures {
    count: u32,
    last: Instant,
}

/// What to do about one world.
#[derive(Debug, Default, PartialEq, Eq)]
struct Plan {
    /// Ends these.
    end: Vec<SimulationId>,
    /// Starts one.
    start: bool,
}

/// Interval between two comparisons.
const TICK: Duration = Duration::from_millis(500);
/// Number of simulations that start at a time: their starts are in nobody's way.
const STARTS: usize = 2;
/// Time after a client's arrival in which none is started: others of its class are about to come, and starts, of containers
/// above all, would delay them.
const CALM: Duration = Duration::from_secs(3);
/// Bounds of the pause after a failed start, which doubles each time.
const PAUSE: (Duration, Duration) = (Duration::from_secs(2), Duration::from_mins(10));
/// Memory in use, beyond the load up to which simulations are started, from which some end, in percent.
const SCARCE: f64 = 10.0;

impl Failures {
    fn pause(&self) -> Duration {
        let doubled = PAUSE.0.saturating_mul(1 << self.count.saturating_sub(1).min(16));
        doubled.min(PAUSE.1)
    }
}

impl SpareKeeper {
    /// Keeps simulations of this server ready.
    pub fn new(server: Arc<AppState>) -> Self {
        Self {
            server,
            repositories: HashMap::new(),
            worlds: BTreeMap::new(),
            arrivals: (0, None),
        }
    }

    fn tick(&mut self, ctx: &mut Context<Self>) {
        let wanted = if self.server.is_draining() {
            BTreeMap::new()
        } else {
            self.server.spare_wishes.wanted(Timestamp::now(), Instant::now())
        };
        let mut spares = self.server.slots.spares();
        if wanted.is_empty() && spares.is_empty() && self.worlds.is_empty() {
            return;
        }
        self.follow(&wanted);
        self.ask_remotes(&wanted, ctx);
        let readings = self.server.readings.borrow().clone();
        let limit = self.server.config.ready_load;
        let has_room = readings.load.is_some_and(|load| load.percent() < limit) && memory(&readings) < limit;
        let is_open = self.is_calm() && has_room && !self.server.takes_nobody();
        let starting = spares.values().flatten().filter(|one| !one.is_ready).count();
        let mut starts = STARTS.saturating_sub(starting);
        let mut has_slot = self.server.slots.has_room_for_spare();
        for kind in self.worlds.keys() {
            spares.entry(kind.clone()).or_default();
        }
        for (kind, spares) in &spares {
            let number = wanted.get(kind).copied().unwrap_or_default();
            let tip = self.tip_to_start(kind);
            let may_start = is_open && starts > 0 && tip.is_some();
            let plan = plan(number, spares, may_start, has_slot);
            for id in plan.end {
                self.server.slots.end_spare(id);
            }
            if plan.start {
                starts -= 1;
                self.start_one(kind.clone(), tip, ctx);
                has_slot = self.server.slots.has_room_for_spare();
            }
        }
        if memory(&readings) >= limit + SCARCE
            && let Some(one) = spares
                .values()
                .flatten()
                .filter(|one| !one.is_reserved)
                .max_by_key(|one| (!one.is_ready, one.id))
        {
            self.server.slots.end_spare(one.id);
        }
    }

    /// Whether no client has come lately.
    fn is_calm(&mut self) -> bool {
        let (known, changed) = &mut self.arrivals;
        let arrivals = self.server.slots.instances().arrivals;
        if std::mem::replace(known, arrivals) != arrivals {
            *changed = Some(Instant::now());
        }
        changed.is_none_or(|changed| changed.elapsed() >= CALM)
    }

    /// The commit of a world that may be started now: the pause after its last failed start is over, and at this load the
    /// server takes clients for it.
    fn tip_to_start(&self, kind: &SpareKind) -> Option<Tip> {
        let world = self.worlds.get(kind).filter(|world| world.may_start())?;
        let is_admitted = self.server.rules.check(&kind.world, self.server.load()).is_ok();
        world.tip.clone().filter(|_| is_admitted)
    }

    /// Forgets worlds that are no longer listed, and adds those that are. The remote of one that is wanted from now on is to
    /// be asked at once: a commit from before may be a day old.
    fn follow(&mut self, wanted: &BTreeMap<SpareKind, u32>) {
        self.worlds.retain(|kind, _| wanted.contains_key(kind));
        let mut listed = BTreeSet::new();
        for (kind, count) in wanted {
            let world = self.worlds.entry(kind.clone()).or_default();
            let repository = kind.world.repository();
            let watched = self.repositories.entry(repository.clone()).or_default();
            listed.insert(repository);
            if *count == 0 {
                if world.is_asked {
                    let images = std::mem::take(&mut world.images);
                    *world = ListedWorld {
                        images,
                        ..ListedWorld::default()
                    };
                    self.server.spare_wishes.set_problem(kind, None);
                }
            } else if !world.is_asked {
                world.is_asked = true;
                watched.asked = None;
            }
        }
        self.repositories.retain(|repository, _| listed.contains(repository));
        self.server
            .spare_wishes
            .retain_problems(|kind| wanted.contains_key(kind));
        for world in self.worlds.values_mut() {
            if world
                .failures
                .as_ref()
                .is_some_and(|failures| failures.last.elapsed() > 2 * PAUSE.1)
            {
                world.failures = None;
            }
        }
    }

    /// Asks the remote of each repository whose turn it is. One that is not wanted now is only kept in the cache.
    fn ask_remotes(&mut self, wanted: &BTreeMap<SpareKind, u32>, ctx: &mut Context<Self>) {
        let interval = self.server.config.timing.branches;
        for (repository, watched) in &mut self.repositories {
            if watched.asked.is_some_and(|asked| asked.elapsed() < interval) {
                continue;
            }
            watched.asked = Some(Instant::now());
            let of_repository = wanted.iter().filter(|(kind, _)| kind.world.repository() == *repository);
            let worlds: BTreeSet<ProjectUrl> = of_repository.clone().map(|(kind, _)| kind.world.clone()).collect();
            let is_due = of_repository.clone().any(|(_, count)| *count > 0);
            let refused = worlds
                .iter()
                .find_map(|world| self.server.rules.admit(world, Load::ZERO).err());
            if let Some(refused) = refused {
                for (kind, _) in of_repository {
                    self.server
                        .spare_wishes
                        .set_problem(kind, Some(refused.message.clone()));
                }
                continue;
            }
            let asked = self.server.checkouts.tips(worlds.into_iter().collect(), is_due);
            let (server, repository) = (Arc::clone(&self.server), repository.clone());
            let asked = async move {
                let answer = asked.await;
                let assets = spawn_blocking(move || (server.launcher.assets_of(&repository), repository)).await;
                (answer, assets)
            };
            wrap_future::<_, Self>(asked)
                .map(move |(answer, assets), keeper, _| match assets {
                    Ok((assets, repository)) => keeper.asked(&repository, assets, answer),
                    Err(error) => log::error!("assets can't be looked for: {error}"),
                })
                .spawn(ctx);
        }
    }

    /// A remote has said what its branches are.
    fn asked(&mut self, repository: &str, assets: Option<Arc<RepositoryAssets>>, answer: Result<Tips, Failure>) {
        let Tips { tips, kept } = match answer {
            Ok(tips) => tips,
            Err(failure) => return self.not_asked(repository, &failure),
        };
        if let Some(watched) = self.repositories.get_mut(repository) {
            watched.kept = Some((kept, assets));
            watched.is_failing = false;
        }
        for (kind, world) in &mut self.worlds {
            let Some(tip) = tips.get(&kind.world) else { continue };
            // The problem was the remote.
            if world.failures.is_none() {
                self.server.spare_wishes.set_problem(kind, None);
            }
            match world.tip.replace(tip.clone()) {
                Some(before) if before != *tip => {
                    log::info!(
                        "{}: its branch has moved: those that are kept ready are replaced",
                        kind.world
                    );
                    self.server.slots.outdate_spares(kind);
                    world.failures = None;
                }
                _ => {}
            }
        }
    }

    /// A remote could not be asked. What is ready stays, and others are started with the commit that it has said before.
    fn not_asked(&mut self, repository: &str, failure: &Failure) {
        let Some(watched) = self.repositories.get_mut(repository) else {
            return;
        };
        if !std::mem::replace(&mut watched.is_failing, true) {
            log::warn!(
                "the branches of {repository}, of which worlds are kept ready, can't be read: {} ({}). That is tried again",
                failure.in_full(),
                failure.reason
            );
        }
        for kind in self.worlds.keys().filter(|kind| kind.world.repository() == repository) {
            self.server
                .spare_wishes
                .set_problem(kind, Some(failure.message.clone()));
        }
    }

    /// One of this world is ready.
    fn is_ready(&mut self, kind: &SpareKind, images: Vec<ImageUse>) {
        if let Some(world) = self.worlds.get_mut(kind) {
            world.images = images;
        }
        self.server.spare_wishes.set_problem(kind, None);
    }

    /// Counts a failed start, and logs the first one until failures are forgotten.
    fn failed(&mut self, kind: &SpareKind, failure: &Failure) {
        let Some(world) = self.worlds.get_mut(kind) else { return };
        let now = Instant::now();
        let failures = world.failures.get_or_insert(Failures { count: 0, last: now });
        failures.count += 1;
        failures.last = now;
        if failures.count == 1 {
            log::warn!(
                "{} can't be kept ready: {} ({}). That is tried again, with growing pauses",
                kind.world,
                failure.in_full(),
                failure.reason
            );
        }
        self.server
            .spare_wishes
            .set_problem(kind, Some(failure.message.clone()));
    }

    fn start_one(&self, kind: SpareKind, tip: Option<Tip>, ctx: &mut Context<Self>) {
        Session::open_spare(&self.server, kind, tip, ctx.address().recipient());
    }
}

impl ListedWorld {
    /// Whether the pause after its last failed start is over.
    fn may_start(&self) -> bool {
        let failures = self.failures.as_ref();
        failures.is_none_or(|failures| failures.last.elapsed() >= failures.pause())
    }
}

/// What to do if this many of a world are wanted and these are there. `has_slot`: a slot is free for one more.
fn plan(wanted: u32, spares: &[SpareStatus], may_start: bool, has_slot: bool) -> Plan {
    let wanted = usize::try_from(wanted).unwrap_or(usize::MAX);
    let (outdated, mut fresh): (Vec<&SpareStatus>, Vec<&SpareStatus>) = spares.iter().partition(|one| one.is_outdated);
    let ready = fresh.iter().filter(|one| one.is_ready).count();
    let is_starting = ready < fresh.len();
    // Those that start end first, then the newest.
    fresh.sort_by_key(|one| (!one.is_reserved, !one.is_ready, one.id));
    let surplus = fresh
        .iter()
        .skip(wanted)
        .filter(|one| !one.is_reserved)
        .map(|one| one.id);
    let replaced = (ready + outdated.len()).saturating_sub(wanted);
    let mut old = outdated.iter().filter(|one| !one.is_reserved).map(|one| one.id);
    let mut end: Vec<SimulationId> = surplus.chain(old.by_ref().take(replaced)).collect();
    let start = may_start && fresh.len() < wanted && (outdated.is_empty() || !is_starting);
    // Without a free slot an old one has to end first.
    if start && !has_slot && end.is_empty() {
        end.extend(old.next());
    }
    Plan {
        end,
        start: start && has_slot,
    }
}

/// Memory in use, of the machine or of the GPU that has most left, in percent.
fn memory(readings: &Readings) -> f64 {
    let gpu = readings.gpus.iter().map(|gpu| gpu.memory).reduce(f64::min);
    readings.machine.memory.max(gpu.unwrap_or_default())
}

impl Actor for SpareKeeper {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.run_interval(TICK, Self::tick);
    }
}

impl Handler<SpareEvent> for SpareKeeper {
    type Result = ();

    fn handle(&mut self, event: SpareEvent, _: &mut Self::Context) {
        match event {
            SpareEvent::Ready(kind, images) => self.is_ready(&kind, images),
            SpareEvent::Failed(kind, failure) => self.failed(&kind, &failure),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One for each letter: `r` ready, `s` starting, `p` ready and promised; in capitals: outdated.
    fn spares(letters: &str) -> Vec<SpareStatus> {
        let one = |letter: char| SpareStatus {
            id: SimulationId::next(),
            is_ready: !letter.eq_ignore_ascii_case(&'s'),
            is_outdated: letter.is_ascii_uppercase(),
            is_reserved: letter.eq_ignore_ascii_case(&'p'),
        };
        letters.chars().map(one).collect()
    }

    #[test]
    fn new_ones_come_before_old_ones_go() {
        for (wanted, there, may_start, has_slot, ended, starts, why) in [
            (2, "", true, true, "", true, "the first"),
            (2, "", false, true, "", false, "it may not start"),
            (2, "", true, false, "", false, "no slot is free"),
            (2, "rs", true, true, "", false, "enough"),
            (1, "rs", true, true, "1", false, "one too many: the one that starts"),
            (0, "rsp", true, true, "01", false, "none is wanted; a promise holds"),
            (3, "RRR", true, true, "", true, "moved: the first new one"),
            (3, "RRRs", true, true, "", false, "one at a time"),
            (
                3,
                "RRRr",
                true,
                true,
                "0",
                true,
                "it is ready: an old one ends, and the next starts",
            ),
            (3, "RPRr", true, true, "0", true, "a promised one is not replaced"),
            (
                3,
                "RRR",
                true,
                false,
                "0",
                false,
                "no slot is free: an old one makes room",
            ),
            (3, "RRRr", true, false, "0", false, "one ends, which frees a slot"),
            (3, "RRR", false, true, "", false, "the new one fails: the old ones stay"),
            (0, "RRR", true, true, "012", false, "moved, and none is wanted"),
        ] {
            let there = spares(there);
            let plan = plan(wanted, &there, may_start, has_slot);
            let of = |id: &SimulationId| there.iter().position(|one| one.id == *id).unwrap().to_string();
            let mut found: Vec<String> = plan.end.iter().map(of).collect();
            found.sort();
            assert_eq!((found.concat().as_str(), plan.start), (ended, starts), "{why}");
        }
    }

    #[test]
    fn pauses_grow_and_are_bounded() {
        let pause = |count| {
            Failures {
                count,
                last: Instant::now(),
            }
            .pause()
            .as_secs()
        };
        assert_eq!([1, 2, 3, 9, 10, 60].map(pause), [2, 4, 8, 512, 600, 600]);
    }
}
