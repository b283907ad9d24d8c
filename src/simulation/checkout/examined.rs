//! Whether cached repositories are in order. To read one may take long: that is done aside, once for all who ask, and
//! what was found holds for a while, so that the next client whose world can't be had does not make the server read it
//! again. Nobody waits long for it, and nobody who leaves ends it.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use futures_util::future::{BoxFuture, Shared};
use tokio::sync::Semaphore;

use super::cached_repository::InUse;
use super::git::Git;
use super::repository_cache::RepositoryCache;

/// The repositories that were examined, or are now; one for the whole server.
#[derive(Debug)]
pub struct Examined {
    git: Arc<Git>,
    cache: RepositoryCache,
    patience: Duration,
    turns: Arc<Semaphore>,
    all: Mutex<HashMap<PathBuf, Examination>>,
}

/// Gives whether everything was in order, and when that was found.
type Examination = Shared<BoxFuture<'static, (bool, Instant)>>;

/// So long it is taken to be so.
const TRUST: Duration = Duration::from_mins(3);
/// How long an examination may take. One that takes longer has found nothing.
const LIMIT: Duration = Duration::from_mins(10);
/// So many repositories are read at a time: a forge that fails, fails for all of its repositories at once.
const AT_A_TIME: usize = 2;

impl Examined {
    /// Examines repositories of this cache. Nobody waits for that longer than `patience`.
    #[must_use]
    pub fn new(git: Arc<Git>, cache: RepositoryCache, patience: Duration) -> Self {
        Self { git, cache, patience, turns: Arc::new(Semaphore::new(AT_A_TIME)), all: Mutex::default() }
    }

    /// Whether nothing is known to be broken in a repository, now or within the last minutes.
    pub async fn is_sound(&self, repository: &Path) -> bool {
        let examination = self.examination(repository);
        actix_rt::time::timeout(self.patience, examination).await.map_or(true, |(is_sound, _)| is_sound)
    }

    /// Forgets that a repository was found to be broken, for it is removed. Gives back whether it was: not if somebody
    /// else was here first.
    pub fn forget_broken(&self, repository: &Path) -> bool {
        let mut all = self.all();
        let found = all.get(repository).and_then(|examination| examination.peek().copied());
        let is_broken = found.is_some_and(|(is_sound, _)| !is_sound);
        if is_broken {
            all.remove(repository);
        }
        is_broken
    }

    fn examination(&self, repository: &Path) -> Examination {
        let mut all = self.all();
        all.retain(|_, examination| examination.peek().is_none_or(|(_, when)| when.elapsed() < TRUST));
        if let Some(examination) = all.get(repository) {
            return examination.clone();
        }
        let (git, cache, turns) = (Arc::clone(&self.git), self.cache.clone(), Arc::clone(&self.turns));
        // Until then it is not removed.
        let in_use = self.cache.visit(repository);
        let examination = async move {
            let _turn = turns.acquire().await;
            let is_sound = match &in_use {
                Some(repository) => look(&git, repository).await,
                // It is being removed.
                None => true,
            };
            drop(in_use);
            // Whoever tidied up meanwhile had to leave it.
            cache.grown();
            (is_sound, Instant::now())
        };
        let examination = examination.boxed().shared();
        tokio::spawn(examination.clone());
        all.insert(repository.to_owned(), examination.clone());
        examination
    }

    fn all(&self) -> MutexGuard<'_, HashMap<PathBuf, Examination>> {
        self.all.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

async fn look(git: &Git, repository: &InUse) -> bool {
    let found = actix_rt::time::timeout(LIMIT, git.is_sound(repository.path())).await;
    found.unwrap_or_else(|_| {
        log::warn!("{} could not be examined within {} s", repository.path().display(), LIMIT.as_secs());
        true
    })
}
