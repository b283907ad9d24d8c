//! One cached repository: a bare repository into which git fetches commits of one remote, one fetch at a time.

use std::ffi::OsStr;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use parking_lot::Mutex;
use rustix::process::Resource;
use tokio::sync::{Notify, Semaphore, watch};

use super::checkout_error::CheckoutError;
use super::disk::{blocking, remove_leftovers};
use super::git::{Git, LITTLE_MEMORY, stall_timeout};
use super::single_flight::{OnProgress, SingleFlight};
use crate::simulation::config::Remote;
use crate::simulation::process::{Run, remove_tree};

/// A cached repository. It is not evicted from the cache until this is dropped.
pub struct Repository {
    /// Its directory.
    pub path: PathBuf,
    /// The remote, with the last requested spelling of its URL.
    pub remote: Mutex<Remote>,
    /// Runs its commands.
    pub git: Arc<Git>,
    /// Whether a fetch or a checkout may have enlarged it.
    pub has_grown: AtomicBool,
    /// Notified on drop if the repository has grown.
    growth: Arc<Notify>,
    /// Held by the task that changes the repository.
    lock: Arc<tokio::sync::Mutex<()>>,
    /// Limits concurrent queries of the remote: a class may request many worlds of one repository at once.
    queries: Semaphore,
    /// The fetches in progress, by the arguments of git.
    fetches: SingleFlight<Vec<String>, Result<(), CheckoutError>>,
}

/// The name of the remote in git's arguments. git records what a partial history lacks only for named remotes.
pub const REMOTE: &str = "origin";
/// Number of concurrent queries of a remote for one repository.
const MAX_QUERIES: usize = 4;

impl Repository {
    /// The repository at `path`, which need not exist yet, for commits of `remote`.
    pub fn new(path: PathBuf, remote: Remote, git: Arc<Git>, growth: Arc<Notify>) -> Self {
        let (lock, fetches, queries) = (Arc::default(), SingleFlight::default(), Semaphore::new(MAX_QUERIES));
        let (remote, has_grown) = (Mutex::new(remote), AtomicBool::default());
        Self {
            path,
            remote,
            git,
            has_grown,
            growth,
            lock,
            queries,
            fetches,
        }
    }

    /// A git command on this repository.
    pub fn call(&self, arguments: &[impl AsRef<OsStr>]) -> Run {
        let url = format!("remote.{REMOTE}.url={}", self.remote.lock().location);
        self.configured(&[url], arguments)
    }

    /// A git command on this repository with only these settings, each as `name=value`, and without the remote's URL.
    pub fn configured(&self, settings: &[String], arguments: &[impl AsRef<OsStr>]) -> Run {
        self.git
            .command((&self.path, self.remote.lock().protocol), settings, arguments)
    }

    /// Runs a command that only reads the repository. Returns its answer.
    ///
    /// # Errors
    /// When git fails.
    pub async fn read(&self, arguments: &[impl AsRef<OsStr>]) -> Result<Vec<u8>, CheckoutError> {
        let mut call = self.call(arguments);
        // git must not fetch missing objects, as it would in a history.
        let none = [("GIT_ALLOW_PROTOCOL", "none"), ("GIT_NO_LAZY_FETCH", "1")];
        call.spec
            .environment
            .extend(none.map(|(name, value)| (name.into(), value.into())));
        self.git.run(call, |_| ()).await
    }

    /// Joins an identical fetch in progress, or starts one. Cancelled when the last waiter drops. `progress` receives
    /// git's progress lines.
    ///
    /// # Errors
    /// Why it can't be fetched.
    pub async fn fetch(
        self: &Arc<Self>,
        arguments: Vec<String>,
        progress: OnProgress<'_>,
    ) -> Result<(), CheckoutError> {
        let (this, key) = (Arc::clone(self), arguments.clone());
        let fetch = |sender: watch::Sender<String>| async move {
            let guard = if let Ok(guard) = Arc::clone(&this.lock).try_lock_owned() {
                guard
            } else {
                sender.send_replace("waiting for another fetch".to_owned());
                Arc::clone(&this.lock).lock_owned().await
            };
            this.has_grown.store(true, Relaxed);
            this.create().await?;
            let on_line = |line: &str| {
                if line.contains('%') {
                    sender.send_replace(line.trim_start_matches("remote: ").to_owned());
                }
            };
            let mut call = this.call(&arguments);
            // A larger write ends git with SIGXFSZ, which must not leave a core dump.
            call.limits.extend([
                (Resource::Core, 0),
                (Resource::Fsize, this.git.config.project_size << 20),
            ]);
            this.git.run(call, on_line).await?;
            // Packs the repository, within a timeout. Only the next fetch waits for that.
            tokio::spawn(async move {
                let _guard = guard;
                let call = Run {
                    time: stall_timeout(&this.git.config),
                    ..this.call(&["gc", "--auto", "--quiet"])
                };
                if let Err(error) = this.git.run(call, |_| ()).await {
                    log::warn!("{} can't be packed: {error}", this.path.display());
                }
            });
            Ok(())
        };
        self.fetches.join(key, progress, fetch).await
    }

    /// Queries the remote. Returns its answer.
    ///
    /// # Errors
    /// When git fails.
    pub async fn ask(&self, arguments: &[impl AsRef<OsStr>]) -> Result<String, CheckoutError> {
        // The semaphore is never closed.
        let _permit = self.queries.acquire().await.ok();
        let mut call = self.call(arguments);
        call.limits.push((Resource::Data, LITTLE_MEMORY));
        let answer = self.git.run(call, |_| ()).await?;
        Ok(String::from_utf8_lossy(&answer).into_owned())
    }

    /// Creates the bare repository if it does not exist, otherwise removes what a killed git has left.
    async fn create(&self) -> Result<(), CheckoutError> {
        let path = self.path.clone();
        let is_there = blocking(move || {
            // The last directory that `git init` creates: without it, git was killed before.
            let is_there = path.join("objects/pack").is_dir();
            if is_there {
                remove_leftovers(&path);
            } else {
                remove_tree(&path)?;
            }
            Ok(is_there)
        });
        if !is_there.await? {
            self.git.run(self.call(&["init", "--quiet", "--bare"]), |_| ()).await?;
        }
        Ok(())
    }

    /// Discards the repository.
    ///
    /// # Errors
    /// When it can't be removed.
    pub async fn discard(&self) -> io::Result<()> {
        let _guard = self.lock.lock().await;
        let path = self.path.clone();
        blocking(move || remove_tree(&path)).await
    }
}

impl Drop for Repository {
    fn drop(&mut self) {
        if *self.has_grown.get_mut() {
            self.growth.notify_one();
        }
    }
}
