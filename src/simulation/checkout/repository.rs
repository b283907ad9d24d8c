//! One cached repository: a bare repository into which git fetches commits of one remote, one fetch at a time.

use std::ffi::OsStr;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use parking_lot::Mutex;
use rustix::process::Resource;
use tokio::sync::{Notify, OwnedMutexGuard, Semaphore, watch};

use super::disk::{blocking, remove_leftovers};
use super::git::{Git, LITTLE_MEMORY, stall_timeout};
use super::git_error::GitError;
use super::single_flight::{OnProgress, SingleFlight};
use crate::simulation::config::{Remote, SimulationConfig};
use crate::simulation::process::{Run, remove_tree};

/// A cached repository. It is not evicted from the cache until this is dropped.
pub struct Repository {
    /// Its folder.
    pub path: PathBuf,
    /// The remote. Its URL may have several spellings.
    remote: Mutex<Remote>,
    git: Arc<Git>,
    config: Arc<SimulationConfig>,
    /// Signals that the cache has grown.
    pub growth: Arc<Notify>,
    /// Held by the task that changes the repository.
    lock: Arc<tokio::sync::Mutex<()>>,
    /// Limits concurrent queries of the remote: a class may want as many worlds of one repository.
    queries: Semaphore,
    /// The fetches in progress, by the arguments of git.
    fetches: SingleFlight<Vec<String>, Result<(), GitError>>,
}

/// What arguments of git call the remote. git keeps note of what a partial history lacks only for remotes that have a name.
pub const REMOTE: &str = "origin";
/// Number of concurrent queries of a remote for one repository.
const MAX_QUERIES: usize = 4;

impl Repository {
    /// The repository at `path`, which need not exist yet, for commits of `remote`.
    pub fn new(
        path: PathBuf,
        remote: Remote,
        git: Arc<Git>,
        config: Arc<SimulationConfig>,
        growth: Arc<Notify>,
    ) -> Self {
        let (lock, fetches, queries) = (Arc::default(), SingleFlight::default(), Semaphore::new(MAX_QUERIES));
        Self { path, remote: Mutex::new(remote), git, config, growth, lock, queries, fetches }
    }

    /// Where it is fetched from.
    pub fn remote(&self) -> Remote {
        self.remote.lock().clone()
    }

    /// Changes the remote to the last requested spelling of its URL.
    pub fn set_remote(&self, remote: &Remote) {
        self.remote.lock().clone_from(remote);
    }

    /// A git command on this repository.
    pub fn call(&self, arguments: &[impl AsRef<OsStr>]) -> Run {
        self.configured(&[format!("remote.{REMOTE}.url={}", self.remote().location)], arguments)
    }

    /// A git command on this repository with these settings alone, each as `name=value`: it can't ask the remote.
    pub fn configured(&self, settings: &[String], arguments: &[impl AsRef<OsStr>]) -> Run {
        self.git.command((&self.path, self.remote().protocol), settings, arguments)
    }

    /// Runs a command to its end. Returns its answer. `on_line` receives each line of standard error.
    ///
    /// # Errors
    /// When git fails.
    pub async fn run(&self, call: Run, on_line: impl FnMut(&str)) -> Result<Vec<u8>, GitError> {
        self.git.run(call, on_line).await
    }

    /// Runs a command that only reads the repository. Returns its answer.
    ///
    /// # Errors
    /// When git fails.
    pub async fn read(&self, arguments: &[impl AsRef<OsStr>]) -> Result<Vec<u8>, GitError> {
        let mut call = self.call(arguments);
        // Missing objects must not be fetched, as git would do in a history.
        let none = [("GIT_ALLOW_PROTOCOL", "none"), ("GIT_NO_LAZY_FETCH", "1")];
        call.spec.environment.extend(none.map(|(name, value)| (name.into(), value.into())));
        self.run(call, |_| ()).await
    }

    /// Joins an identical fetch in progress, or starts one. Cancelled when the last waiter drops. `progress` receives
    /// git's progress lines.
    ///
    /// # Errors
    /// Why it can't be fetched.
    pub async fn fetch(self: &Arc<Self>, arguments: Vec<String>, progress: OnProgress<'_>) -> Result<(), GitError> {
        let (this, key) = (Arc::clone(self), arguments.clone());
        self.fetches.join(key, progress, |sender| async move { this.fetch_locked(&arguments, &sender).await }).await
    }

    async fn fetch_locked(
        self: &Arc<Self>,
        arguments: &[String],
        sender: &watch::Sender<String>,
    ) -> Result<(), GitError> {
        let _grown = Grown(&self.growth);
        let guard = self.lock(sender).await;
        self.create().await?;
        let on_line = |line: &str| {
            if line.contains('%') {
                sender.send_replace(line.trim_start_matches("remote: ").to_owned());
            }
        };
        let mut call = self.call(arguments);
        // A larger write ends git with SIGXFSZ, which must not leave a core dump.
        call.limits.extend([(Resource::Core, 0), (Resource::Fsize, self.config.project_size << 20)]);
        self.run(call, on_line).await?;
        self.collect_garbage(guard);
        Ok(())
    }

    /// Asks the remote. Returns its answer.
    ///
    /// # Errors
    /// When git fails.
    pub async fn ask(&self, arguments: &[impl AsRef<OsStr>]) -> Result<String, GitError> {
        // It is never closed.
        let _permit = self.queries.acquire().await.ok();
        let mut call = self.call(arguments);
        call.limits.push((Resource::Data, LITTLE_MEMORY));
        let answer = self.run(call, |_| ()).await?;
        Ok(String::from_utf8_lossy(&answer).into_owned())
    }

    /// Waits until no other task changes the repository.
    async fn lock(&self, sender: &watch::Sender<String>) -> OwnedMutexGuard<()> {
        let lock = Arc::clone(&self.lock);
        if let Ok(guard) = Arc::clone(&lock).try_lock_owned() {
            return guard;
        }
        sender.send_replace("waiting for another fetch".to_owned());
        lock.lock_owned().await
    }

    /// Creates the bare repository unless it exists. Else removes what a killed git has left.
    async fn create(&self) -> Result<(), GitError> {
        let path = self.path.clone();
        let is_there = blocking(move || {
            // The last folder that git makes of a new repository. A git that was killed before has left locks.
            let is_there = path.join("objects/pack").is_dir();
            if is_there {
                remove_leftovers(&path);
            } else {
                remove_tree(&path)?;
            }
            Ok(is_there)
        });
        if !is_there.await? {
            self.run(self.call(&["init", "--quiet", "--bare"]), |_| ()).await?;
        }
        Ok(())
    }

    /// Runs `git gc --auto` in the background, for at most `stall_timeout()`; only the next fetch waits for it.
    fn collect_garbage(self: &Arc<Self>, guard: OwnedMutexGuard<()>) {
        let this = Arc::clone(self);
        tokio::spawn(async move {
            let _guard = guard;
            let call = Run { time: stall_timeout(&this.config), ..this.call(&["gc", "--auto", "--quiet"]) };
            if let Err(error) = this.run(call, |_| ()).await {
                log::warn!("{} can't be packed: {error}", this.path.display());
            }
        });
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

/// On drop, marks the cache as grown, whatever the outcome.
struct Grown<'cache>(&'cache Notify);

impl Drop for Grown<'_> {
    fn drop(&mut self) {
        self.0.notify_one();
    }
}
