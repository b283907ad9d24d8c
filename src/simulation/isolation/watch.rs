//! Watches over what a running simulation takes: room on the disk, processes, ports.
//!
//! The kernel has no boundary for these that every machine offers to an ordinary user. So they are looked at every few
//! seconds, and a simulation that takes more than its share is ended.

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::simulation::config::Resources;
use crate::simulation::machine::count_threads;
use crate::simulation::process::folder_size::{self, FolderSize};
use crate::simulation::process::process_tree;

/// What is watched of one simulation.
#[derive(Debug)]
pub struct Watch {
    /// The process from which all of it descends.
    pub root: i32,
    /// How many of these processes are what runs the simulation, and none of its own.
    pub runners: u64,
    /// The folder of the instance.
    pub folder: PathBuf,
    /// What it may take.
    pub limits: Resources,
    /// The ports of all simulations, of which one may be its own.
    pub ports: RangeInclusive<u16>,
}

/// Time between two looks, at least.
const PAUSE: Duration = Duration::from_secs(1);
/// Time between two looks, at most: who makes looks slow gains no more than this.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);
/// So many times as long as a look takes is the time between two of them: a fiftieth of a core goes into it, where it is short.
const RARELY: u32 = 50;

impl Watch {
    /// Waits until the simulation takes more than it may, and tells what, in words for its client.
    pub async fn until_too_much(self) -> String {
        let folder = self.folder.clone();
        let before = actix_rt::task::spawn_blocking(move || folder_size::room_of(&folder)).await;
        let before = before.ok().flatten().unwrap_or_default();
        let watch = std::sync::Arc::new(self);
        let mut pause = PAUSE;
        loop {
            actix_rt::time::sleep(pause).await;
            let (begin, watch) = (Instant::now(), std::sync::Arc::clone(&watch));
            let found = actix_rt::task::spawn_blocking(move || watch.look(before)).await;
            if let Ok(Some(excess)) = found {
                return excess;
            }
            pause = pause_after(begin.elapsed());
        }
    }

    /// Looks once. `before` is the size of the folder when the simulation began.
    fn look(&self, before: u64) -> Option<String> {
        let Resources { disk, processes, .. } = self.limits;
        let allowed = before.saturating_add(disk << 20);
        let mut size = FolderSize::new(folder_size::room, allowed);
        if size.add_folder(&self.folder).is_err() {
            return Some("The simulation has folders that nobody can look into, too deep or closed".to_owned());
        }
        // In a sandbox they have other names, but without one it can write elsewhere, which does not count.
        let within = if self.runners == 0 { self.folder.as_path() } else { Path::new("/") };
        size.add_nameless(self.root, &self.folder, within);
        if size.total() > allowed {
            return Some(format!(
                "The simulation has written more than {disk} MiB, the limit of this server (limits.disk)"
            ));
        }
        if count_threads(self.root) > processes.saturating_add(self.runners) {
            return Some(format!(
                "The simulation has more than {processes} processes and threads, the limit of this server (limits.processes)"
            ));
        }
        let taken = process_tree::listening_ports(self.root, &self.ports);
        let taken: Vec<String> = taken.iter().map(u16::to_string).collect();
        (taken.len() > 1)
            .then(|| format!("The simulation listens on the ports {}, of which only one is its own", taken.join(", ")))
    }
}

/// How long to wait after a look that took so long.
fn pause_after(look: Duration) -> Duration {
    (look * RARELY).clamp(PAUSE, LONGEST_PAUSE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_look_does_not_put_the_next_one_off_for_long() {
        let millis = Duration::from_millis;
        for (look, pause) in [(1, 1000), (100, 5000), (20_000, 10_000)] {
            assert_eq!(pause_after(millis(look)), millis(pause));
        }
    }
}
