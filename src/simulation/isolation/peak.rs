//! The peak usage of a simulation without a control group of its own, from the readings of all simulations.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::docker_cgroup::taken_by_container;
use crate::simulation::ends::Taken;
use crate::simulation::machine::Usage;

/// The highest usage of a simulation that ticks have measured.
#[derive(Debug, Default)]
pub struct Peak {
    /// Its containers, if it runs in some; its process tree here does not count then.
    containers: Option<OnceLock<Vec<String>>>,
    /// In bytes; 0 before the first tick.
    memory: AtomicU64,
    /// Processor time, in milliseconds.
    time: AtomicU64,
}

impl Peak {
    /// For a simulation that runs in containers.
    #[must_use]
    pub fn of_containers() -> Self {
        Self { containers: Some(OnceLock::new()), ..Self::default() }
    }

    /// Names the containers, by their ids.
    pub fn name_containers(&self, ids: Vec<String>) {
        if let Some(containers) = &self.containers {
            // They never change.
            containers.set(ids).ok();
        }
    }

    /// Whether the usage of its process tree is that of the simulation.
    #[must_use]
    pub fn is_of_tree(&self) -> bool {
        self.containers.is_none()
    }

    /// Adds a reading: of the process tree, or the kernel's counters of its containers.
    pub fn look(&self, tree: Option<&Usage>) {
        match &self.containers {
            Some(containers) => {
                let taken = containers.get().into_iter().flatten().map(|id| taken_by_container(id));
                let (memory, time) = taken.fold((0, Duration::ZERO), |(memory, time), taken| {
                    (memory + taken.memory.unwrap_or_default(), time + taken.time.unwrap_or_default())
                });
                self.add(memory, time);
            }
            None => tree.iter().for_each(|usage| self.add(usage.memory, usage.time)),
        }
    }

    fn add(&self, memory: u64, time: Duration) {
        self.memory.fetch_max(memory, Ordering::Relaxed);
        self.time.fetch_max(u64::try_from(time.as_millis()).unwrap_or(u64::MAX), Ordering::Relaxed);
    }

    /// The usage; its fields are `None` if the simulation ended before the first tick.
    #[must_use]
    pub fn taken(&self) -> Taken {
        let (memory, time) = (self.memory.load(Ordering::Relaxed), self.time.load(Ordering::Relaxed));
        let is_known = memory > 0 || time > 0;
        Taken { memory: Some(memory).filter(|memory| *memory > 0), time: is_known.then(|| Duration::from_millis(time)) }
    }
}
