//! The processes of this server that were started before this one, and serve their last clients.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::join_all;
use parking_lot::Mutex;

use super::control::{ForwardedStop, Reply, Request, ask};
use crate::shared::domain::ProjectUrl;
use crate::simulation::process::{is_alive, runs_in};
use crate::simulation::run_id::RunId;
use crate::simulation::slots::SlotPool;
use crate::simulation::snapshot::Holdings;

/// The processes before this one, with what each has. None is ever added.
pub struct Predecessors {
    runs: PathBuf,
    known: Mutex<BTreeMap<RunId, Holdings>>,
    slots: Arc<SlotPool>,
}

/// Interval between two looks at them.
const PERIOD: Duration = Duration::from_millis(250);
/// Timeout of an answer.
const ANSWER: Duration = Duration::from_secs(2);

impl Predecessors {
    /// Those that live at the start. What they have is not free in `slots`.
    pub fn new(cache: &Path, living: Vec<RunId>, slots: Arc<SlotPool>) -> Self {
        let known = living.into_iter().map(|run| (run, Holdings::default())).collect();
        Self {
            runs: runs_in(cache),
            known: Mutex::new(known),
            slots,
        }
    }

    /// Whether all have ended.
    pub fn is_empty(&self) -> bool {
        self.known.lock().is_empty()
    }

    /// The directory of a process.
    pub fn folder(&self, run: RunId) -> PathBuf {
        self.runs.join(run.folder())
    }

    /// Asks each what it has. The next one's `publish` counts it.
    pub async fn look(&self) {
        let runs: Vec<RunId> = self.known.lock().keys().copied().collect();
        let questions = runs.into_iter().map(async |run| {
            let folder = self.folder(run);
            match ask(&folder, &Request::Look, ANSWER).await {
                Ok(Reply::Holdings(holdings)) => self.told(run, holdings),
                // It has ended; one that hangs has what it had.
                _ if !is_alive(&folder) => drop(self.known.lock().remove(&run)),
                _ => {}
            }
        });
        join_all(questions).await;
    }

    /// Records what one has.
    pub fn told(&self, run: RunId, mut holdings: Holdings) {
        for simulation in &mut holdings.simulations {
            simulation.repository =
                ProjectUrl::parse(&simulation.world).map_or_else(|_| String::new(), |url| url.repository());
        }
        self.known.lock().insert(run, holdings);
    }

    /// Counts what they have in the slots.
    pub fn publish(&self) {
        let mut all = Holdings::default();
        for holdings in self.known.lock().values() {
            all.add(holdings);
        }
        self.slots.set_others(all);
    }

    /// Follows what they have until all have ended.
    pub async fn follow(self: Arc<Self>) {
        while !self.is_empty() {
            actix_rt::time::sleep(PERIOD).await;
            self.look().await;
            if !self.slots.is_superseded() {
                self.publish();
            }
        }
    }

    /// The directory of the process that has a simulation.
    pub fn with_simulation(&self, id: &str) -> Option<PathBuf> {
        let known = self.known.lock();
        let mut all = known
            .iter()
            .flat_map(|(run, has)| has.simulations.iter().map(move |one| (run, one)));
        let (run, _) = all.find(|(_, one)| one.id.to_string() == id)?;
        Some(self.folder(*run))
    }

    /// Has those of these simulations stopped that they have. Returns the ids of those that are being stopped.
    pub async fn stop(&self, order: ForwardedStop) -> Vec<String> {
        let processes: BTreeSet<PathBuf> = order.ids.iter().filter_map(|id| self.with_simulation(id)).collect();
        let request = Request::Stop(order);
        let answers = processes
            .iter()
            .map(async |folder| match ask(folder, &request, ANSWER).await {
                Ok(Reply::Done(ids)) => ids.split_whitespace().map(str::to_owned).collect(),
                other => {
                    log::warn!("the process of {} stops nothing: {other:?}", folder.display());
                    Vec::new()
                }
            });
        join_all(answers).await.concat()
    }

    /// Has all of them end in an orderly way.
    pub fn end(&self) {
        let runs: Vec<RunId> = self.known.lock().keys().copied().collect();
        for folder in runs.into_iter().map(|run| self.folder(run)) {
            actix_rt::spawn(async move {
                if let Err(error) = ask(&folder, &Request::End, ANSWER).await {
                    log::warn!("the process of {} does not answer: {error}", folder.display());
                }
            });
        }
    }
}
