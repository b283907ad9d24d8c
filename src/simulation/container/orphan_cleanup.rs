//! Removes orphaned compose projects and unused images.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use nix::sys::statvfs::statvfs;
use parking_lot::{Mutex, MutexGuard};
use tokio::sync::Notify;

use super::check::data_folder;
use super::docker::{Docker, DockerError};
use super::image::Images;
use super::owned_resources::{self, ResourceOwner};
use crate::simulation::config::SimulationConfig;

/// The compose projects in use.
#[derive(Debug, Clone, Default)]
pub struct ActiveProjects(Arc<(Mutex<HashSet<String>>, Notify)>);

/// Longest time between two sweeps for orphans; a released project triggers one sooner.
const PERIOD: Duration = Duration::from_mins(1);
/// Delay before each sweep, and between retries.
const AGAIN: Duration = Duration::from_secs(2);
/// Interval between image prunings.
const PRUNE: Duration = Duration::from_mins(30);
/// How old an image is at least that is removed because the disk is full, in hours: one that was just built has no container
/// yet.
const YOUNGEST: u64 = 1;

impl ActiveProjects {
    /// Adds a name.
    pub fn insert(&self, name: &str) {
        self.names().insert(name.to_owned());
    }

    /// Removes a name, and triggers a sweep.
    pub fn remove(&self, name: &str) {
        self.names().remove(name);
        self.0.1.notify_one();
    }

    fn names(&self) -> MutexGuard<'_, HashSet<String>> {
        self.0.0.lock()
    }
}

/// Removes orphaned compose projects and unused images.
pub async fn run_cleanup(
    docker: Docker,
    owner: ResourceOwner,
    live: ActiveProjects,
    images: Arc<Images>,
    config: Arc<SimulationConfig>,
) {
    let mut pruned: Option<Instant> = None;
    // What an earlier run has left may have filled the disk.
    let mut pause = Duration::ZERO;
    loop {
        actix_rt::time::timeout(pause, live.0.1.notified()).await.ok();
        // Most is removed by then without a sweep.
        actix_rt::time::sleep(AGAIN).await;
        pause = match tidy(&docker, &owner, &live).await {
            Ok(0) => PERIOD,
            // Containers that Docker was removing when it was stopped appear one by one.
            Ok(_) => AGAIN,
            Err(error) => {
                log::debug!("containers that nobody uses are not removed yet: {error}");
                AGAIN
            }
        };
        let reserve = config.disk_reserve;
        let is_full = actix_rt::task::spawn_blocking(move || is_disk_full(reserve)).await.unwrap_or_default();
        if is_full || pruned.is_none_or(|at| at.elapsed() > PRUNE) {
            let hours = if is_full { YOUNGEST } else { 24 * config.container.images_age };
            if let Err(error) = images.prune(hours).await {
                log::warn!("images that nobody needs are not removed: {error}");
            }
            pruned = Some(Instant::now());
        }
    }
}

/// Whether the disk of Docker's images has less room than new simulations need, in MiB.
fn is_disk_full(reserve: u64) -> bool {
    let about = data_folder().and_then(|folder| statvfs(&folder).ok());
    about.is_some_and(|disk| disk.blocks_available().saturating_mul(disk.fragment_size()) >> 20 < reserve)
}

/// Removes what is left. Returns how many projects it has found.
async fn tidy(docker: &Docker, owner: &ResourceOwner, live: &ActiveProjects) -> Result<usize, DockerError> {
    let found = owner.projects(docker).await?;
    let left: Vec<String> = found.into_iter().filter(|name| !live.names().contains(name)).collect();
    let mut done = Ok(left.len());
    for name in left {
        // A failed removal does not stop the others.
        match owned_resources::remove(docker, &name).await {
            Ok(()) => log::info!("{name} was left: removed"),
            Err(error) => done = Err(error),
        }
    }
    done
}
