//! Removes orphaned compose projects and unused images.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use tokio::sync::Notify;

use super::check::data_folder;
use super::image::Images;
use super::owned_resources::{self, ResourceOwner};
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::DiskRoom;

/// The compose projects in use.
#[derive(Debug, Clone, Default)]
pub struct ActiveProjects(Arc<(Mutex<HashSet<String>>, Notify)>);

/// The name of a compose project. Until this is dropped, its containers do not count as orphans.
#[derive(Debug)]
pub struct ProjectGuard {
    /// The name; unique on this machine.
    pub name: String,
    active: ActiveProjects,
}

/// Longest time between two sweeps for orphans; a released project triggers one sooner.
const SWEEP_INTERVAL: Duration = Duration::from_mins(1);
/// Delay before each sweep, and between retries.
const RETRY_INTERVAL: Duration = Duration::from_secs(2);
/// Interval between image prunings.
const PRUNE_INTERVAL: Duration = Duration::from_mins(30);
/// How old an image is at least that is removed because the disk is full, in hours: one that was just built has no container
/// yet.
const MIN_AGE: u64 = 1;

impl ActiveProjects {
    /// Marks a name as in use.
    #[must_use]
    pub fn insert(&self, name: String) -> ProjectGuard {
        self.0.0.lock().insert(name.clone());
        ProjectGuard { name, active: self.clone() }
    }
}

impl Drop for ProjectGuard {
    fn drop(&mut self) {
        self.active.0.0.lock().remove(&self.name);
        self.active.0.1.notify_one();
    }
}

/// Removes orphaned compose projects and unused images.
pub async fn run_cleanup(
    owner: ResourceOwner,
    active: ActiveProjects,
    images: Arc<Images>,
    config: Arc<SimulationConfig>,
) {
    let mut pruned: Option<Instant> = None;
    // What an earlier run has left may have filled the disk.
    let mut pause = Duration::ZERO;
    loop {
        actix_rt::time::timeout(pause, active.0.1.notified()).await.ok();
        // Most is removed by then without a sweep.
        actix_rt::time::sleep(RETRY_INTERVAL).await;
        let (of, used) = (owner.clone(), active.clone());
        let is_used = move |name: &str| used.0.0.lock().iter().any(|project| name.starts_with(project));
        let sweep = move || owned_resources::sweep(&of, is_used);
        pause = match actix_rt::task::spawn_blocking(sweep).await {
            Ok(Ok(left)) if left.is_empty() => SWEEP_INTERVAL,
            // Containers that Docker was removing when it was stopped appear one by one.
            Ok(Ok(left)) => {
                log::info!("{} was left: removed", left.join(", "));
                RETRY_INTERVAL
            }
            // Docker does not answer, or another process removes the same.
            failed => {
                log::debug!("what was left is not removed yet: {failed:?}");
                RETRY_INTERVAL
            }
        };
        let reserve = config.disk_reserve;
        let is_full = actix_rt::task::spawn_blocking(move || is_disk_full(reserve)).await.unwrap_or_default();
        if is_full || pruned.is_none_or(|at| at.elapsed() > PRUNE_INTERVAL) {
            let hours = if is_full { MIN_AGE } else { 24 * config.container.images_age };
            match images.prune(hours).await {
                // Docker prunes for one at a time, also of other servers.
                Err(error) if error.to_string().contains("already running") => pause = RETRY_INTERVAL,
                done => {
                    if let Err(error) = done {
                        log::warn!("images that nobody needs are not removed: {error}");
                    }
                    pruned = Some(Instant::now());
                }
            }
        }
    }
}

/// Whether the disk of Docker's images has less room than new simulations need, in MiB.
fn is_disk_full(reserve: u64) -> bool {
    let room = data_folder().and_then(|folder| DiskRoom::of(&folder).ok());
    room.is_some_and(|room| room.shortage(reserve).is_some())
}
