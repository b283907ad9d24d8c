//! Brings commits from remotes into cached repositories: each once, side by side, bounded in size.
//!
//! A fetch that stands still is begun anew, so that nobody who has joined it late loses time by that.

use std::ffi::OsString;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use super::cached_repository::{CommitInUse, InUse, arrived, received};
use super::errand::{Errand, call};
use super::error::{CheckoutError, damaged, fetch_failed, git_failed, machine, too_large};
use super::examined::Examined;
use super::git::{Call, Git, GitError};
use super::limits::Limits;
use super::mirrors::Remote;
use super::quarantine::Quarantine;
use super::repository_cache::{Patient, RepositoryCache};
use super::revision::{self, Revision};
use super::single_flight::Joint;

/// Fetches; one for the whole server.
#[derive(Debug)]
pub struct Downloads {
    /// Runs git.
    pub git: Arc<Git>,
    /// Where to.
    pub cache: RepositoryCache,
    /// What may be fetched.
    pub limits: Limits,
    /// What was found to be in order.
    pub examined: Examined,
    /// The commits that are being fetched now, by where they are and what they are; or by what git is asked for.
    commits: Joint<Vec<OsString>, Attempt>,
}

/// The hash of a commit that was fetched.
type Arrival = (String, Arc<CommitInUse>);
/// What git was asked for, and what came.
type Attempt = (Vec<OsString>, Result<Arrival, CheckoutError>);

/// Between two looks at how much a fetch has brought.
const BETWEEN_LOOKS: Duration = Duration::from_millis(200);

impl Downloads {
    /// Prepares fetches into this cache.
    #[must_use]
    pub fn new(git: Arc<Git>, cache: RepositoryCache, limits: Limits) -> Self {
        let examined = Examined::new(Arc::clone(&git), cache.clone(), limits.patience());
        Self { git, cache, limits, examined, commits: Joint::default() }
    }

    /// Fetches one commit, unless it is there, together with everybody who wants it for whatever world. Gives back what
    /// came: a branch may have moved on in the meantime.
    ///
    /// # Errors
    /// Why it can't be fetched.
    pub async fn commit(
        self: &Arc<Self>,
        errand: Errand<'_>,
        revision: &Revision,
    ) -> Result<(Revision, Arc<CommitInUse>), CheckoutError> {
        let Errand { world, remote, progress } = errand;
        let asked = revision.fetch_arguments(&remote.location);
        let tell = |step| drop(progress.send_replace(step));
        let join = |key| {
            let (this, world, remote, wanted) = (Arc::clone(self), world.clone(), remote.clone(), revision.clone());
            let asked = asked.clone();
            self.commits.join(key, &tell, |progress| async move {
                (asked, this.fetch(Errand { world: &world, remote: &remote, progress: &progress }, &wanted).await)
            })
        };
        let (by_name, mut result) = join(vec![remote.location.clone().into(), revision.reference().into()]).await;
        let is_it = result.as_ref().is_ok_and(|(came, _)| *came == revision.commit);
        if by_name != asked && !is_it {
            // Another name of the commit: what has become of that one says nothing of this.
            (_, result) = join(asked.clone()).await;
        }
        let (came, commit) = result?;
        Ok((revision.with_commit(came), commit))
    }

    async fn fetch(&self, errand: Errand<'_>, revision: &Revision) -> Result<Arrival, CheckoutError> {
        let Errand { world, remote, .. } = errand;
        let failed = |error| machine(world, &error);
        let repository = &self.cache.take(&remote.location).await.map_err(failed)?;
        // In the end, what is left of the fetch may be removed.
        let _grown = Grown(&self.cache);
        let fetched = loop {
            if !repository.is_made() {
                let _right = repository.fetching().await.map_err(failed)?;
                self.make_repository(errand, repository, &revision.commit).await?;
            }
            let quarantine = Quarantine::enter(repository, &revision.commit).await.map_err(failed)?;
            if let Some(commit) = repository.commit(&revision.reference()) {
                return Ok((revision.commit.clone(), Arc::new(commit)));
            }
            let right = repository.fetching_later(|| errand.tell_wait()).await.map_err(failed)?;
            quarantine.make(repository, &right).map_err(failed)?;
            drop(right);
            let call = call(remote, quarantine.path(), revision.fetch_arguments(&remote.location));
            match self.receive(errand, call, &format!("fetching {}", world.repository())).await {
                Received::Silence => self.tell_silence(errand),
                Received::All(result) => break result.map(|()| quarantine),
                Received::TooMuch => {
                    return Err(too_large(format!("{} (at depth 1)", world.repository()), self.limits.size));
                }
            }
        };
        let quarantine = fetched.map_err(|source| fetch_failed(world, revision, source))?;
        let incoming = quarantine.path().join(revision.incoming());
        let lost = || machine(world, &io::Error::other("the commit that was fetched is not there"));
        let came = arrived(&incoming).ok_or_else(lost)?;
        let reference = revision.with_commit(came.clone()).reference();
        let right = repository.fetching().await.map_err(failed)?;
        quarantine.hand_over(repository, &right).map_err(failed)?;
        // Taken before anybody else may tidy up.
        let commit = repository.name(&right, &incoming, &reference).ok_or_else(lost)?;
        Ok((came, Arc::new(commit)))
    }

    /// Says that a remote is asked anew.
    pub fn tell_silence(&self, errand: Errand<'_>) {
        let seconds = self.limits.patience().as_secs_f64();
        log::warn!("{}: nothing has come for {seconds} s, git starts anew", errand.world.repository());
    }

    /// Whether a commit was ever part of a branch or tag. For that the history is fetched: all commits, as far as the
    /// remote allows without the files that belong to them.
    ///
    /// # Errors
    /// Why the history can't be had.
    pub async fn is_in_history(&self, errand: Errand<'_>, commit: &str) -> Result<bool, CheckoutError> {
        let Errand { world, remote, .. } = errand;
        let failed = |error| machine(world, &error);
        let history = self.cache.take(&history_of(&remote.location)).await.map_err(failed)?;
        if history.is_made()
            && history.packed() <= self.limits.size
            && self.is_reachable(errand, &history, commit).await?
        {
            return Ok(true);
        }
        let too_much = || too_large(format!("The history of {}", world.repository()), self.limits.size);
        let _grown = Grown(&self.cache);
        loop {
            // There is but one history to fetch: others who want it wait for it.
            let _right = history.fetching_later(|| errand.tell_wait()).await.map_err(failed)?;
            self.make_repository(errand, &history, commit).await?;
            let mut call = call(remote, history.path(), revision::history_arguments("origin"));
            call.environment.extend(setting("remote.origin.url", &remote.location));
            match self.receive(errand, call, &format!("fetching the history of {}", world.repository())).await {
                Received::Silence => self.tell_silence(errand),
                Received::All(Err(source)) => return Err(git_failed(world, source)),
                Received::All(Ok(())) if history.packed() <= self.limits.size => {
                    return self.is_reachable(errand, &history, commit).await;
                }
                Received::All(Ok(())) | Received::TooMuch => return Err(too_much()),
            }
        }
    }

    async fn is_reachable(&self, errand: Errand<'_>, history: &InUse, commit: &str) -> Result<bool, CheckoutError> {
        let mut call = call(errand.remote, history.path(), revision::reachable_arguments(commit));
        // A commit that is not there must not be asked for: the remote might have it from elsewhere.
        call.protocol = "none";
        call.environment.push(("GIT_NO_LAZY_FETCH".into(), "1".into()));
        match self.git.run(call, |_| ()).await {
            Ok(answer) => Ok(!answer.is_empty()),
            Err(error) if error.message.contains("no such commit") => Ok(false),
            // git before 2.44 wants to fetch it, and may not.
            Err(error) if error.message.contains("transport") && error.message.contains("not allowed") => Ok(false),
            Err(source) => Err(damaged(errand.world, source)),
        }
    }

    /// Runs a fetch, and ends git when it brings too much, or nothing any more.
    async fn receive(&self, errand: Errand<'_>, call: Call<'_>, what: &str) -> Received {
        let repository = call.repository;
        let lines = AtomicUsize::new(0);
        let tell = |line: &str| {
            lines.fetch_add(1, Ordering::Relaxed);
            if line.contains('%') {
                errand.progress.send_replace(format!("{what}: {}", line.trim_start_matches("remote: ")));
            }
        };
        let mut fetch = std::pin::pin!(self.git.run(call, tell));
        let mut look = actix_rt::time::interval(BETWEEN_LOOKS);
        let mut last_sign = (Instant::now(), (0, 0));
        loop {
            tokio::select! {
                result = &mut fetch => return Received::All(result.map(drop)),
                _ = look.tick() => {
                    let signs = (received(repository), lines.load(Ordering::Relaxed));
                    if signs.0 > self.limits.size {
                        return Received::TooMuch;
                    }
                    if signs != last_sign.1 {
                        last_sign = (Instant::now(), signs);
                    } else if last_sign.0.elapsed() > self.limits.patience() {
                        return Received::Silence;
                    }
                }
            }
        }
    }

    /// Makes the bare repository for commits like this one, unless it is there. It takes its place only when it is whole.
    async fn make_repository(&self, errand: Errand<'_>, repository: &InUse, commit: &str) -> Result<(), CheckoutError> {
        if repository.is_made() {
            return Ok(());
        }
        let failed = |error| machine(errand.world, &error);
        let path = repository.path();
        let new = path.with_extension("new");
        for broken in [&new, path] {
            if broken.exists() {
                tokio::fs::remove_dir_all(broken).await.map_err(failed)?;
            }
        }
        let call = call(errand.remote, &new, revision::init_arguments(commit));
        self.git.run(call, |_| ()).await.map_err(|source| git_failed(errand.world, source))?;
        tokio::fs::rename(&new, path).await.map_err(failed)
    }

    /// Removes what is cached of a remote if it is damaged, so that the next fetch begins anew.
    ///
    /// # Errors
    /// When it can't be removed.
    pub async fn mend(&self, remote: &Remote) -> io::Result<()> {
        for location in [&remote.location, &history_of(&remote.location)] {
            let repository = self.cache.take(location).await?;
            if !repository.path().exists() || self.examined.is_sound(repository.path()).await {
                continue;
            }
            drop(repository);
            let patient = self.cache.examine(location).await?;
            let path = match &patient {
                Patient::Alone { path, .. } => path,
                Patient::Shared(repository, _) => repository.path(),
            };
            if self.examined.forget_broken(path) {
                log::warn!("{} is damaged: it is removed and fetched anew", path.display());
                self.cache.mend(patient).await?;
            }
        }
        Ok(())
    }
}

/// How a fetch has ended.
enum Received {
    /// git has ended by itself.
    All(Result<(), GitError>),
    /// It has brought more than may come.
    TooMuch,
    /// Nothing has come for too long.
    Silence,
}

/// Says in the end, whichever that is, that something was added to the cache.
struct Grown<'cache>(&'cache RepositoryCache);

impl Drop for Grown<'_> {
    fn drop(&mut self) {
        self.0.grown();
    }
}

/// By which the history of a remote is known in the cache.
fn history_of(location: &str) -> String {
    format!("{location} history")
}

/// The variables that give git one more setting.
#[must_use]
pub fn setting(name: &str, value: &str) -> [(OsString, OsString); 3] {
    [("GIT_CONFIG_COUNT", "1"), ("GIT_CONFIG_KEY_0", name), ("GIT_CONFIG_VALUE_0", value)]
        .map(|(name, value)| (name.into(), value.into()))
}
