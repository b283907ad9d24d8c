//! One cached repository: a bare repository into which git fetches commits of one remote, one fetch at a time; and why a
//! checkout failed, as its next step needs to know it.
//!
//! What git prints is passed on to the client, and decides nothing: it contains names that projects choose. Only the
//! headers of answers in its trace do (`http_trace`), which the Git host writes.

use std::ffi::OsStr;
use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use parking_lot::Mutex;
use rustix::process::Resource;
use sha2::{Digest, Sha256};
use tokio::sync::{OwnedMutexGuard, Semaphore};

use super::disk::{has_unfinished_pack, remove_leftovers, spawn_blocking_io};
use super::git::{Git, GitError, GitExit, LITTLE_MEMORY, stall_timeout};
use super::http_trace::{HttpTrace, TRACE};
use super::overlap::Overlap;
use super::single_flight::{SingleFlight, Steps};
use crate::shared::domain::{Failure, ProjectUrl, Reason};
use crate::simulation::config::Remote;
use crate::simulation::process::{Run, own_call_failed, remove_tree};

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
    /// Its checkouts.
    pub checkouts: Overlap,
    /// The number of its generation: another one after it was replaced or discarded.
    generation: AtomicU64,
    /// Notified on drop if the repository has grown.
    growth: mpsc::Sender<()>,
    /// Held by the task that changes the repository.
    lock: Arc<tokio::sync::Mutex<()>>,
    /// Limits concurrent queries of the remote: a class may request many worlds of one repository at once.
    queries: Semaphore,
    /// The fetches in progress, by the arguments of git.
    fetches: SingleFlight<Vec<String>, Result<(), CheckoutError>, String>,
}

/// Why a checkout failed.
#[derive(Debug, Clone)]
pub enum CheckoutError {
    /// For this reason.
    Failed(Failure),
    /// For this reason; the name of the repository comes before the message.
    OfRepository(Failure),
    /// The remote redirects to this location, if it names one.
    Moved(Option<String>),
    /// The remote has no such commit, or does not serve it.
    NoCommit,
    /// The remote answers, but does not hand out what was asked for, as this failure says.
    NotServed(Failure),
    /// A cached repository can't be read, although the machine works.
    Unreadable(Unreadable),
}

/// A cached repository that can't be read: it is damaged, or else the content of its project can't be used. That shows
/// when it is fetched anew.
#[derive(Debug, Clone)]
pub struct Unreadable {
    /// The repository.
    pub repository: Arc<Repository>,
    /// Its generation that was read.
    pub generation: u64,
    /// The failure if it is not the repository's damage; the name of the repository comes before the message.
    pub failure: Failure,
}

/// The name of the remote in git's arguments. git records what a partial history lacks only for named remotes.
pub const REMOTE: &str = "origin";
/// A query that each repository answers.
const ANY: [&str; 5] = ["ls-remote", "--quiet", "--", REMOTE, "HEAD"];
/// Number of concurrent queries of a remote for one repository.
const MAX_QUERIES: usize = 4;

/// Interval between two attempts to get a lock that another process has.
const BETWEEN_ATTEMPTS: Duration = Duration::from_millis(50);

/// What keeps other fetches from a repository until it is dropped: those of this process, and of others of this server.
type FetchLock = (OwnedMutexGuard<()>, File);

/// The file whose lock a process holds while it fetches into the repository at this path. Two bytes of a hash name it:
/// there are never more than 65,536 files, and hardly two repositories that wait for each other.
fn lock_file(path: &Path) -> io::Result<File> {
    let hash = Sha256::digest(path.as_os_str().as_encoded_bytes());
    let name = hex::encode(hash.first_chunk::<2>().unwrap_or(&[0; 2]));
    let folder = path.ancestors().nth(2).unwrap_or(path).join("locks");
    std::fs::create_dir_all(&folder)?;
    let mut options = File::options();
    options.write(true).create(true).truncate(false).open(folder.join(name))
}

impl Repository {
    /// The repository at `path`, which need not exist yet, for commits of `remote`.
    pub fn new(path: PathBuf, remote: Remote, git: Arc<Git>, growth: mpsc::Sender<()>) -> Self {
        Self {
            path,
            remote: Mutex::new(remote),
            git,
            has_grown: AtomicBool::default(),
            checkouts: Overlap::default(),
            generation: AtomicU64::new(next_generation()),
            growth,
            lock: Arc::default(),
            queries: Semaphore::new(MAX_QUERIES),
            fetches: SingleFlight::default(),
        }
    }

    /// The generation that is in use. What is read afterwards is of this generation, or of a later one.
    pub fn generation(&self) -> u64 {
        self.generation.load(Relaxed)
    }

    /// A git command on this repository.
    pub fn call(&self, arguments: &[impl AsRef<OsStr>]) -> Run {
        self.call_in(&self.path, arguments)
    }

    /// A git command on the repository in this directory, with the same remote.
    fn call_in(&self, folder: &Path, arguments: &[impl AsRef<OsStr>]) -> Run {
        let protocol = self.remote.lock().protocol;
        self.git.command((folder, protocol), &[self.url()], arguments)
    }

    /// The setting that names the remote.
    fn url(&self) -> String {
        format!("remote.{REMOTE}.url={}", self.remote.lock().location)
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
    pub async fn read(&self, arguments: &[impl AsRef<OsStr>]) -> Result<Vec<u8>, GitError> {
        let mut call = self.call(arguments);
        // git must not fetch missing objects, as it would in a history.
        let none = [("GIT_ALLOW_PROTOCOL", "none"), ("GIT_NO_LAZY_FETCH", "1")];
        call.spec
            .environment
            .extend(none.map(|(name, value)| (name.into(), value.into())));
        self.git.run(call, |_| ()).await
    }

    /// Waits until nobody else fetches, here or in another process of this server; calls `waits` if somebody does.
    async fn lock(&self, waits: impl Fn()) -> io::Result<FetchLock> {
        let here = Arc::clone(&self.lock);
        let here = if let Ok(here) = Arc::clone(&here).try_lock_owned() {
            here
        } else {
            waits();
            here.lock_owned().await
        };
        let file = lock_file(&self.path)?;
        let mut attempt = file.try_lock();
        if matches!(attempt, Err(TryLockError::WouldBlock)) {
            waits();
        }
        while matches!(attempt, Err(TryLockError::WouldBlock)) {
            actix_rt::time::sleep(BETWEEN_ATTEMPTS).await;
            attempt = file.try_lock();
        }
        attempt?;
        Ok((here, file))
    }

    /// Joins an identical fetch in progress, or starts one. Cancelled when the last waiter drops. `progress` receives
    /// git's progress lines.
    ///
    /// # Errors
    /// Why it can't be fetched.
    pub async fn fetch(
        self: &Arc<Self>,
        arguments: Vec<String>,
        progress: &(dyn Fn(String) + Send + Sync),
    ) -> Result<(), CheckoutError> {
        let this = Arc::clone(self);
        let key = arguments.clone();
        let fetch = |lines: Steps<String>| async move {
            let lock = this.lock(|| lines.send("waiting for another fetch".to_owned())).await?;
            this.has_grown.store(true, Relaxed);
            let on_line = |line: &str| {
                if line.contains('%') {
                    lines.send(line.trim_start_matches("remote: ").to_owned());
                }
            };
            this.fetch_now(&arguments, on_line).await?;
            // Packs the repository, within a timeout. Only the next fetch waits for that.
            tokio::spawn(async move {
                let _lock = lock;
                let call = Run {
                    time: stall_timeout(&this.git.config),
                    ..this.call(&["gc", "--auto", "--quiet"])
                };
                if let Err(error) = this.git.run(call, |_| ()).await {
                    log::warn!("{} can't be packed: {error:?}", this.path.display());
                }
            });
            Ok(())
        };
        self.fetches.join(key, progress, fetch).await
    }

    /// Fetches. Requires the lock.
    async fn fetch_now(&self, arguments: &[String], mut on_line: impl FnMut(&str)) -> Result<(), CheckoutError> {
        self.create(&self.path).await?;
        let exit = match self.fetch_into(&self.path, arguments, &mut on_line).await {
            Ok(()) => return Ok(()),
            Err(GitError::NotRun(failure)) => return Err(CheckoutError::OfRepository(failure)),
            Err(GitError::Ended(exit)) => exit,
        };
        if let Some(failure) = self.git.machine_fault().await {
            return Err(CheckoutError::Failed(failure));
        }
        // The kernel ends a git that writes more.
        if has_unfinished_pack(&self.path, self.max_pack()) {
            let message = format!("is larger than {} MiB", self.git.config.project_size);
            return Err(CheckoutError::OfRepository(Failure::new(
                Reason::ProjectTooLarge,
                message,
            )));
        }
        self.ask(&ANY).await?;
        // The remote answers: either it does not serve this, or the cached repository is damaged.
        let fresh = self.git.scratch()?;
        self.create(fresh.path()).await?;
        match self.fetch_into(fresh.path(), arguments, &mut on_line).await {
            Ok(()) => Ok(self.replace_by(fresh).await?),
            Err(GitError::NotRun(failure)) => Err(CheckoutError::OfRepository(failure)),
            Err(GitError::Ended(_)) => Err(CheckoutError::NotServed(exit.failure(Reason::RemoteFailed))),
        }
    }

    /// Fetches into the repository in this directory.
    async fn fetch_into(&self, folder: &Path, arguments: &[String], on_line: impl FnMut(&str)) -> Result<(), GitError> {
        let mut call = self.call_in(folder, arguments);
        // A larger write ends git with SIGXFSZ, which must not leave a core dump.
        call.limits
            .extend([(Resource::Core, 0), (Resource::Fsize, self.max_pack())]);
        self.git.run(call, on_line).await.map(drop)
    }

    /// Limit of a pack, in bytes.
    fn max_pack(&self) -> u64 {
        self.git.config.project_size << 20
    }

    /// Queries the remote. Returns its answer.
    ///
    /// # Errors
    /// When git fails: why, as the answer of the remote tells, or else the state of this machine.
    pub async fn ask(&self, arguments: &[impl AsRef<OsStr>]) -> Result<String, CheckoutError> {
        // The semaphore is never closed.
        let _permit = self.queries.acquire().await.ok();
        let remote = self.remote.lock().clone();
        let mut call = self.git.query(remote.protocol, &[self.url()], arguments);
        call.limits.push((Resource::Data, LITTLE_MEMORY));
        let variables = TRACE.map(|name| (name.into(), "1".into()));
        call.spec.environment.extend(variables);
        let mut trace = HttpTrace::default();
        match self.git.run(call, |line| trace.note(line)).await {
            Ok(answer) => Ok(String::from_utf8_lossy(&answer).into_owned()),
            Err(GitError::NotRun(failure)) => Err(CheckoutError::OfRepository(failure)),
            Err(GitError::Ended(exit)) => Err(self.not_answered(&remote, trace, exit).await),
        }
    }

    /// Why a query of the remote has failed.
    async fn not_answered(&self, remote: &Remote, trace: HttpTrace, exit: GitExit) -> CheckoutError {
        let is_missing = match trace.status {
            Some(300..=399) => return CheckoutError::Moved(trace.location),
            // Git hosts don't distinguish private from missing repositories.
            Some(401 | 403 | 404 | 410) => true,
            _ => remote.protocol == "file" && !is_there(&remote.location),
        };
        if is_missing {
            let message = "does not exist or is not public";
            return CheckoutError::OfRepository(Failure::new(Reason::RepositoryNotFound, message));
        }
        if let Some(failure) = self.git.machine_fault().await {
            return CheckoutError::Failed(failure);
        }
        // The hosts come from the configuration, and nothing in a project changes whether they answer.
        let is_silent = remote.protocol != "file" && trace.status.is_none();
        CheckoutError::OfRepository(exit.failure(if is_silent {
            Reason::RemoteUnreachable
        } else {
            Reason::RemoteFailed
        }))
    }

    /// The error of a read of this generation that has failed: the machine does not work, or the repository is damaged, or
    /// its content can't be used.
    pub async fn unreadable(self: &Arc<Self>, generation: u64, error: GitError) -> CheckoutError {
        let exit = match error {
            GitError::NotRun(failure) => return CheckoutError::OfRepository(failure),
            GitError::Ended(exit) => exit,
        };
        match self.git.machine_fault().await {
            Some(failure) => CheckoutError::Failed(failure),
            None => CheckoutError::Unreadable(Unreadable {
                repository: Arc::clone(self),
                generation,
                failure: exit.failure(Reason::InvalidProject),
            }),
        }
    }

    /// Creates a bare repository in this directory if there is none, otherwise removes what a killed git has left.
    async fn create(&self, folder: &Path) -> Result<(), CheckoutError> {
        let path = folder.to_owned();
        let is_there = spawn_blocking_io(move || {
            // The last directory that `git init` creates: without it, git was killed before.
            let is_there = path.join("objects/pack").is_dir();
            if is_there {
                remove_leftovers(&path);
            } else {
                remove_tree(&path)?;
            }
            Ok(is_there)
        });
        if is_there.await? {
            return Ok(());
        }
        let init = self.call_in(folder, &["init", "--quiet", "--bare"]);
        let failure = match self.git.run(init, |_| ()).await {
            Ok(_) => return Ok(()),
            Err(GitError::NotRun(failure)) => failure,
            Err(GitError::Ended(exit)) => exit.failure(Reason::ServerFault),
        };
        Err(match self.git.machine_fault().await {
            Some(failure) => CheckoutError::Failed(failure),
            None => CheckoutError::OfRepository(failure),
        })
    }

    /// Replaces this repository by a new one. Requires the lock. Commands that read the old one may fail.
    async fn replace_by(&self, fresh: tempfile::TempDir) -> io::Result<()> {
        log::warn!("{} is damaged: it was fetched anew", self.path.display());
        let old = self.git.scratch()?;
        let path = self.path.clone();
        spawn_blocking_io(move || {
            set_aside(&path, old.path())?;
            std::fs::rename(fresh.keep(), path)?;
            remove_tree(old.path())
        })
        .await?;
        self.generation.store(next_generation(), Relaxed);
        Ok(())
    }

    /// Discards the repository if it still is of this generation. Returns the generation that is in use then.
    ///
    /// # Errors
    /// When it can't be moved aside.
    pub async fn discard(&self, generation: u64) -> io::Result<u64> {
        let lock = self.lock(|| {}).await?;
        let current = self.generation();
        if current != generation {
            return Ok(current);
        }
        let old = self.git.scratch()?;
        let path = self.path.clone();
        let old = spawn_blocking_io(move || set_aside(&path, old.path()).map(|()| old)).await?;
        let next = next_generation();
        self.generation.store(next, Relaxed);
        drop(lock);
        // Others need not wait for this.
        spawn_blocking_io(move || remove_tree(old.path())).await?;
        Ok(next)
    }
}

/// A number that no generation of any repository has had; later ones are higher.
fn next_generation() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Relaxed)
}

/// Moves a repository, if it is there, into a directory.
fn set_aside(repository: &Path, into: &Path) -> io::Result<()> {
    match std::fs::rename(repository, into.join("damaged")) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Whether there is a repository at this path, as git looks for it.
fn is_there(location: &str) -> bool {
    Path::new(location).exists() || Path::new(&format!("{location}.git")).exists()
}

impl CheckoutError {
    /// The failure for a client that requests this world.
    pub(super) fn about(self, world: &ProjectUrl) -> Failure {
        let repository = world.repository();
        let named = |failure: Failure| Failure {
            message: format!("{repository} {}", failure.message),
            ..failure
        };
        match self {
            Self::Failed(failure) => failure,
            Self::OfRepository(failure) if failure.reason == Reason::CheckoutTimeout => Failure {
                message: format!("Fetching {repository} {}", failure.message),
                ..failure
            },
            Self::OfRepository(failure) | Self::NotServed(failure) => named(failure),
            Self::Unreadable(unreadable) => named(unreadable.failure),
            Self::Moved(_) => Failure::new(
                Reason::RepositoryMoved,
                format!("{repository} has moved again and again"),
            ),
            Self::NoCommit => {
                let name = world
                    .candidates()
                    .into_iter()
                    .next()
                    .map(|reading| reading.reference)
                    .unwrap_or_default();
                Failure::new(
                    Reason::CommitNotFound,
                    format!("{repository} has no branch, tag or commit called {name:?}"),
                )
            }
        }
    }
}

/// A failure for this reason, as the client is told.
pub fn failed(reason: Reason, message: impl Into<String>) -> CheckoutError {
    CheckoutError::Failed(Failure::new(reason, message))
}

impl From<io::Error> for CheckoutError {
    fn from(error: io::Error) -> Self {
        Self::Failed(own_call_failed(&error))
    }
}

impl std::fmt::Debug for Repository {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.path.fmt(out)
    }
}

impl Drop for Repository {
    fn drop(&mut self) {
        if *self.has_grown.get_mut() {
            // The cache may be gone.
            self.growth.send(()).ok();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::config::SimulationConfig;

    #[actix_rt::test]
    async fn only_the_generation_that_can_not_be_read_is_discarded() {
        let folder = tempfile::tempdir().unwrap();
        let config: SimulationConfig = serde_json::from_str("{}").unwrap();
        let git = Arc::new(Git::new(folder.path(), Arc::new(config)));
        let remote = Remote {
            location: "https://host/lab/arm".to_owned(),
            protocol: "https",
        };
        let path = folder.path().join("arm.git");
        let repository = Repository::new(path.clone(), remote, git, mpsc::channel().0);
        let damaged = repository.generation();
        std::fs::create_dir(&path).unwrap();
        let next = repository.discard(damaged).await.unwrap();
        assert!(next > damaged && !path.exists());
        // Another client has read the damaged one, too; meanwhile the repository was fetched anew.
        std::fs::create_dir(&path).unwrap();
        assert_eq!(repository.discard(damaged).await.unwrap(), next);
        assert!(path.exists());
    }
}
