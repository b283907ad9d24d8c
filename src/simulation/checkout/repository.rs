//! One cached repository: an ordinary bare one, into which git fetches commits of one remote, one fetch at a time.

use std::ffi::OsString;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{AcquireError, OwnedMutexGuard, Semaphore, SemaphorePermit, watch};
use tokio_util::sync::CancellationToken;

use super::disk::{blocking, packed, received, remove_all, remove_leftovers};
use super::git::{Call, Git, MOST_MEMORY};
use super::git_error::{FetchError, GitError};
use super::growth::Growth;
use super::limits::Limits;
use super::mirrors::Remote;
use super::revision::{self, FetchRequest};
use super::single_flight::SingleFlight;

/// A cached repository. It is not removed from the cache as long as this lives.
#[derive(Debug)]
pub struct Repository {
    path: PathBuf,
    /// Where it is fetched from. Forges have several spellings of it.
    remote: Mutex<Arc<Remote>>,
    git: Arc<Git>,
    limits: Limits,
    growth: Arc<Growth>,
    /// Held by whoever changes the repository.
    lock: Arc<tokio::sync::Mutex<()>>,
    /// Held by whoever asks the remote what it has.
    asking: Semaphore,
    /// The fetches that are wanted, by the name of the request.
    fetches: SingleFlight<String, Result<(), FetchError>>,
    /// When it was made, if this server has made it since it came into use.
    made: Mutex<Option<Instant>>,
}

/// Why a running fetch is ended.
enum Cut {
    /// Nobody waits for it any more.
    Unwanted,
    /// It has brought more than may come.
    TooLarge,
    /// Nothing has come for too long.
    Silent,
}

/// How many questions the remote is asked at a time: its answers may take memory.
const QUESTIONS: usize = 4;
/// Time between two looks at how much a fetch has brought.
const BETWEEN_LOOKS: Duration = Duration::from_millis(200);

impl Repository {
    /// The repository at `path`, which need not exist yet, for commits of `remote`.
    #[must_use]
    pub fn new(path: PathBuf, remote: Remote, git: Arc<Git>, limits: Limits, growth: Arc<Growth>) -> Self {
        let (lock, fetches, made) = (Arc::default(), SingleFlight::default(), Mutex::default());
        let asking = Semaphore::new(QUESTIONS);
        Self { path, remote: Mutex::new(Arc::new(remote)), git, limits, growth, lock, asking, fetches, made }
    }

    /// Where it is fetched from.
    #[must_use]
    pub fn remote(&self) -> Arc<Remote> {
        Arc::clone(&self.remote.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Goes on with another spelling of the remote, the newest that was asked for.
    pub fn set_remote(&self, remote: &Remote) {
        *self.remote.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(remote.clone());
    }

    /// A git command on this repository.
    #[must_use]
    pub fn call(&self, arguments: Vec<OsString>) -> Call<'_> {
        Call {
            repository: &self.path,
            settings: Vec::new(),
            arguments,
            protocol: self.remote().protocol,
            memory: MOST_MEMORY,
            environment: Vec::new(),
        }
    }

    /// Runs a command that only reads the repository. Returns its answer. Where none comes, git is run anew, each time with
    /// twice the time: others wait for the same answer.
    ///
    /// # Errors
    /// When git fails.
    pub async fn read(&self, arguments: Vec<OsString>) -> Result<Vec<u8>, GitError> {
        let mut call = self.call(arguments);
        // What is missing must not be asked for: the remote of a history would be.
        call.protocol = "none";
        call.environment.push(("GIT_NO_LAZY_FETCH".into(), "1".into()));
        let mut patience = self.limits.patience();
        loop {
            if let Some(answer) = self.git.run_within(patience, call.clone()).await {
                return answer;
            }
            self.tell_silence(patience);
            patience *= 2;
        }
    }

    /// Fetches what is wished for, together with everybody who requests for the same. It ends with the last of them.
    /// `progress` is told git's progress.
    ///
    /// # Errors
    /// Why it can't be fetched.
    pub async fn fetch(
        self: &Arc<Self>,
        request: &FetchRequest,
        progress: &(impl Fn(String) + Send + Sync),
    ) -> Result<(), FetchError> {
        let (this, wanted) = (Arc::clone(self), request.clone());
        let fetch = |told| async move {
            // It is a task of its own: git must have ended, however it ends, before the next one may begin.
            let cancelled = CancellationToken::new();
            let _cancels = cancelled.clone().drop_guard();
            let task = tokio::spawn(async move { this.fetch_locked(&wanted, &told, &cancelled).await });
            task.await.unwrap_or_else(|error| Err(FetchError::Machine(error.to_string())))
        };
        self.fetches.join(request.name.clone(), progress, fetch).await
    }

    async fn fetch_locked(
        self: &Arc<Self>,
        request: &FetchRequest,
        told: &watch::Sender<String>,
        cancelled: &CancellationToken,
    ) -> Result<(), FetchError> {
        let _grown = Grown(&self.growth);
        loop {
            let Some(guard) = cancelled.run_until_cancelled(self.lock(told)).await else {
                return Err(FetchError::unwanted());
            };
            self.make(request, cancelled).await?;
            let mut cut = None;
            let lines = AtomicUsize::new(0);
            let tell = |line: &str| {
                lines.fetch_add(1, Ordering::Relaxed);
                if line.contains('%') {
                    told.send_replace(line.trim_start_matches("remote: ").to_owned());
                }
            };
            let end = async {
                cut = Some(tokio::select! {
                    () = cancelled.cancelled() => Cut::Unwanted,
                    cut = self.watch(&lines) => cut,
                });
            };
            let call = Call { settings: request.settings.clone(), ..self.call(request.arguments.clone()) };
            let ended = self.git.run_until(end, call, tell).await;
            match cut {
                Some(Cut::TooLarge) => return Err(FetchError::TooLarge),
                Some(Cut::Silent) if ended.is_err() => self.tell_silence(self.limits.patience()),
                _ => {
                    ended?;
                    self.collect_garbage(guard);
                    return Ok(());
                }
            }
        }
    }

    /// Waits until the remote may be asked what it has.
    ///
    /// # Errors
    /// Never: nobody closes the semaphore.
    pub async fn may_ask(&self) -> Result<SemaphorePermit<'_>, AcquireError> {
        self.asking.acquire().await
    }

    /// Waits until nobody else changes the repository.
    async fn lock(&self, told: &watch::Sender<String>) -> OwnedMutexGuard<()> {
        let lock = Arc::clone(&self.lock);
        if let Ok(guard) = Arc::clone(&lock).try_lock_owned() {
            return guard;
        }
        told.send_replace("waiting for another fetch".to_owned());
        lock.lock_owned().await
    }

    /// Makes the bare repository unless it is there. Else removes what a git that was killed has left.
    async fn make(&self, request: &FetchRequest, cancelled: &CancellationToken) -> Result<(), FetchError> {
        // It takes its place when it is whole.
        let new = self.path.with_extension("new");
        let mut patience = self.limits.patience();
        loop {
            let (path, new_path) = (self.path.clone(), new.clone());
            let is_there = blocking(move || {
                let is_there = path.join("HEAD").is_file();
                let done = if is_there { remove_leftovers(&path) } else { remove_all(&[&path, &new_path]) };
                done.map(|()| is_there)
            });
            if is_there.await? {
                return Ok(());
            }
            let call = Call { repository: &new, ..self.call(revision::init_arguments(request.is_sha256)) };
            if let Some(made) = self.git.run_within(patience, call).await {
                made?;
                break;
            }
            if cancelled.is_cancelled() {
                return Err(FetchError::unwanted());
            }
            self.tell_silence(patience);
            patience *= 2;
        }
        tokio::fs::rename(&new, &self.path).await?;
        *self.made.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
        Ok(())
    }

    /// Waits until a fetch has brought too much, or nothing any more for too long.
    async fn watch(&self, lines: &AtomicUsize) -> Cut {
        let mut last_sign = (Instant::now(), (0, 0));
        loop {
            actix_rt::time::sleep(BETWEEN_LOOKS).await;
            let path = self.path.clone();
            let received = blocking(move || Ok(received(&path))).await.unwrap_or_default();
            if received > self.limits.size {
                return Cut::TooLarge;
            }
            let signs = (received, lines.load(Ordering::Relaxed));
            if signs != last_sign.1 {
                last_sign = (Instant::now(), signs);
            } else if last_sign.0.elapsed() > self.limits.patience() {
                return Cut::Silent;
            }
        }
    }

    /// Says that git starts anew after so long.
    pub fn tell_silence(&self, patience: Duration) {
        let seconds = patience.as_secs_f64();
        log::warn!("{}: nothing has come for {seconds} s, git starts anew", self.remote().location);
    }

    /// Has git pack what many fetches have left. Nobody waits for that but the next fetch, and that not for long.
    fn collect_garbage(self: &Arc<Self>, guard: OwnedMutexGuard<()>) {
        let this = Arc::clone(self);
        tokio::spawn(async move {
            let _guard = guard;
            let call = this.call(["gc", "--auto", "--quiet"].map(OsString::from).to_vec());
            if let Err(error) = this.git.run_until(actix_rt::time::sleep(this.limits.patience()), call, |_| ()).await {
                log::warn!("{} can't be packed: {error}", this.path.display());
            }
        });
    }

    /// Throws the repository away, unless it was made after `since`.
    ///
    /// # Errors
    /// When it can't be removed.
    pub async fn discard(&self, since: Instant) -> io::Result<()> {
        let _guard = self.lock.lock().await;
        if self.made.lock().unwrap_or_else(PoisonError::into_inner).is_some_and(|made| made > since) {
            return Ok(());
        }
        let path = self.path.clone();
        blocking(move || remove_all(&[&path])).await
    }

    /// How many bytes its packs have.
    pub async fn packed(&self) -> u64 {
        let path = self.path.clone();
        blocking(move || Ok(packed(&path))).await.unwrap_or_default()
    }
}

impl Drop for Repository {
    fn drop(&mut self) {
        self.growth.left();
    }
}

/// Says in the end, whichever that is, that the cache has grown.
struct Grown<'cache>(&'cache Growth);

impl Drop for Grown<'_> {
    fn drop(&mut self) {
        self.0.grown();
    }
}
