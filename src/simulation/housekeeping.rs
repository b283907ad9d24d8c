//! Keeps the cache within its budget, in the background: at start, after each fetch, and when somebody has left a
//! repository that could not be removed before.

use std::ffi::OsString;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use super::download::setting;
use super::git::{Call, Git};
use super::quarantine;
use super::repository_cache::RepositoryCache;

/// So many commits of one repository are kept: those that were used last.
const MOST_COMMITS: usize = 64;
/// So many more may come before some are removed, for git then packs the whole repository anew.
const SLACK: usize = 32;
/// How long git may take for that. New fetches into the repository wait for it.
const LIMIT: Duration = Duration::from_mins(2);

/// Tidies up for ever.
pub async fn keep(cache: RepositoryCache, git: Arc<Git>) {
    loop {
        while tidy_up(&cache, &git).await {}
        cache.change().await;
    }
}

/// One round. Gives back whether another one may achieve more.
async fn tidy_up(cache: &RepositoryCache, git: &Git) -> bool {
    let looked_at = cache.clone();
    let Ok(survey) = actix_rt::task::spawn_blocking(move || looked_at.shrink()).await else {
        return false;
    };
    for path in &survey.left {
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
            pack(git, path, forgotten).await;
        }
        if is_too_large && forgotten > 0 {
            return true;
        }
    }
    false
}

/// Removes what no commit needs any more, and makes one pack of the rest.
async fn pack(git: &Git, path: &Path, forgotten: usize) {
    let arguments = ["gc", "--quiet", "--force", "--prune=now"].map(OsString::from).to_vec();
    // There is no hurry, and others use the machine.
    let environment = setting("pack.threads", "1").to_vec();
    let call = Call { repository: path, arguments, protocol: "none", is_alone: false, environment };
    match actix_rt::time::timeout(LIMIT, git.run(call, |_| ())).await {
        Ok(Ok(_)) => log::info!("removed {forgotten} commits from {}", path.display()),
        Ok(Err(error)) => log::warn!("{} can't be tidied up: {error}", path.display()),
        Err(_) => log::warn!("{} can't be tidied up within {} seconds", path.display(), LIMIT.as_secs()),
    }
}
