//! Keeps the cache within its budget, in the background: at start, after each fetch, and when somebody has left a
//! repository that could not be removed before.

use std::collections::HashMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::download::setting;
use super::git::{Call, Git};
use super::quarantine;
use super::repository_cache::RepositoryCache;

/// So many commits of one repository are kept: those that were used last.
const MOST_COMMITS: usize = 64;
/// So many more may come before some are removed, for git then packs the whole repository anew.
const SLACK: usize = 32;
/// A repository that git can't pack is left alone for so long, and twice as long after each further failure.
const FIRST_REST: Duration = Duration::from_mins(10);
/// The longest of these pauses.
const LONGEST_REST: Duration = Duration::from_hours(24);

/// Tidies up for ever. git may take `limit` for one repository: new fetches into it wait for that.
pub async fn keep(cache: RepositoryCache, git: Arc<Git>, limit: Duration) {
    let mut rests = Rests::default();
    loop {
        while tidy_up(&cache, &git, limit, &mut rests).await {}
        cache.change().await;
    }
}

/// One round. Gives back whether another one may achieve more.
async fn tidy_up(cache: &RepositoryCache, git: &Git, limit: Duration, rests: &mut Rests) -> bool {
    let looked_at = cache.clone();
    let Ok(survey) = actix_rt::task::spawn_blocking(move || looked_at.shrink()).await else {
        return false;
    };
    rests.0.retain(|path, _| survey.left.contains(path));
    for path in &survey.left {
        if rests.is_resting(path, Instant::now()) {
            continue;
        }
        let Some(repository) = cache.visit(path) else {
            continue;
        };
        let (commits, packs) = (repository.commits(), repository.packs());
        let is_crowded = commits.max(packs) > MOST_COMMITS + SLACK;
        // A repository that is in use can't go as a whole, but most of its commits can.
        let is_too_large = survey.excess > 0 && commits > 1;
        if !is_crowded && !is_too_large {
            continue;
        }
        let keep = if is_too_large { (commits / 2).min(MOST_COMMITS) } else { MOST_COMMITS };
        // A fetch that is under way counts on all that is there, and is followed by another round.
        let Some(right) = repository.try_fetching() else {
            continue;
        };
        if quarantine::sweep(path) > 0 {
            continue;
        }
        let forgotten = repository.forget(&right, keep);
        if is_crowded || forgotten > 0 {
            match pack(git, path, limit).await {
                Ok(()) => {
                    rests.0.remove(path);
                    log::info!("removed {forgotten} commits from {}", path.display());
                }
                Err(why) => {
                    let minutes = rests.start(path, Instant::now()).as_secs() / 60;
                    log::warn!("{} can't be tidied up, it is left alone for {minutes} minutes: {why}", path.display());
                }
            }
        }
        if is_too_large && forgotten > 0 {
            return true;
        }
    }
    false
}

/// Removes what no commit needs any more, and makes one pack of the rest.
async fn pack(git: &Git, path: &Path, limit: Duration) -> Result<(), String> {
    let arguments = ["gc", "--quiet", "--force", "--prune=now"].map(OsString::from).to_vec();
    // There is no hurry, and others use the machine.
    let environment = setting("pack.threads", "1").to_vec();
    let call = Call { repository: path, arguments, protocol: "none", environment };
    let start = Instant::now();
    // Nobody else may change the repository as long as anything of git is left.
    let packed = git.run_until(actix_rt::time::sleep(limit), call, |_| ()).await;
    packed.map(drop).map_err(|error| {
        let is_late = start.elapsed() >= limit;
        if is_late { format!("git gc took longer than {} seconds", limit.as_secs_f64()) } else { error.to_string() }
    })
}

/// Repositories that git could not pack: until when each is left alone, and how long that pause is in all.
#[derive(Default)]
struct Rests(HashMap<PathBuf, (Instant, Duration)>);

impl Rests {
    fn is_resting(&self, path: &Path, now: Instant) -> bool {
        self.0.get(path).is_some_and(|(end, _)| now < *end)
    }

    /// Notes a failure. Gives back how long the repository is left alone.
    fn start(&mut self, path: &Path, now: Instant) -> Duration {
        let last = self.0.get(path).map(|(_, rest)| *rest);
        let rest = last.map_or(FIRST_REST, |rest| (2 * rest).min(LONGEST_REST));
        self.0.insert(path.to_owned(), (now + rest, rest));
        rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fails_again_and_again_is_left_alone_for_longer_and_longer() {
        let (mut rests, path, mut now) = (Rests::default(), Path::new("a"), Instant::now());
        assert!(!rests.is_resting(path, now));
        let pauses = std::iter::repeat_with(|| {
            let rest = rests.start(path, now);
            assert!(rests.is_resting(path, now + rest / 2));
            assert!(!rests.is_resting(path, now + rest) && !rests.is_resting(Path::new("b"), now));
            now += rest;
            rest.as_secs() / 60
        });
        assert_eq!(pauses.take(10).collect::<Vec<_>>(), [10, 20, 40, 80, 160, 320, 640, 1280, 1440, 1440]);
    }
}
