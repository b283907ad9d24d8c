//! The peak usage of a simulation without a control group of its own, from the readings of all simulations.

use std::sync::OnceLock;

use parking_lot::Mutex;

use super::cgroup::taken_by_container;
use crate::simulation::ends::Taken;
use crate::simulation::machine::Usage;

/// The highest usage of a simulation that ticks have measured.
#[derive(Default)]
pub struct Peak {
    /// Its containers, if it runs in some; its process tree here does not count then.
    containers: Option<OnceLock<Vec<String>>>,
    taken: Mutex<Taken>,
}

impl Peak {
    /// For a simulation that runs in containers.
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
    pub fn is_of_tree(&self) -> bool {
        self.containers.is_none()
    }

    /// Adds a reading: of the process tree, or the kernel's counters of its containers.
    pub fn look(&self, tree: Option<&Usage>) {
        let mut taken = self.taken.lock();
        let mut add = |memory, time| *taken = Taken { memory: taken.memory.max(memory), time: taken.time.max(time) };
        match &self.containers {
            Some(containers) => {
                let all: Vec<Taken> = containers.get().into_iter().flatten().map(|id| taken_by_container(id)).collect();
                let memory = all.iter().filter_map(|one| one.memory).reduce(|one, other| one + other);
                add(memory, all.iter().filter_map(|one| one.time).reduce(|one, other| one + other));
            }
            None => tree.iter().for_each(|usage| add(Some(usage.memory), Some(usage.time))),
        }
    }

    /// The usage; its fields are `None` if the simulation ended before the first tick.
    pub fn taken(&self) -> Taken {
        *self.taken.lock()
    }
}
