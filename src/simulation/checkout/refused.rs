//! What was refused for its size, for a while: it costs once, and not once for each client.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::error::CheckoutError;
use super::mirrors::Remote;
use super::revision::Revision;

/// What was refused.
#[derive(Debug, Default)]
pub struct Refused(Mutex<HashMap<Scope, (Instant, CheckoutError)>>);

/// What a refusal is of: a repository, its history, one of its commits, or a folder of that.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Scope {
    repository: String,
    /// Empty: all of the repository.
    commit: String,
    /// Empty: all of the commit.
    folder: String,
}

/// How long a refusal is remembered.
const REMEMBERED: Duration = Duration::from_mins(10);
/// How many of them.
const MOST: usize = 1000;

impl Scope {
    /// All of a repository.
    #[must_use]
    pub fn repository(remote: &Remote) -> Self {
        Self { repository: remote.key(), commit: String::new(), folder: String::new() }
    }

    /// What is needed only to find a commit by its hash.
    #[must_use]
    pub fn history(remote: &Remote) -> Self {
        Self { commit: "history".to_owned(), ..Self::repository(remote) }
    }

    /// A commit.
    #[must_use]
    pub fn commit(remote: &Remote, revision: &Revision) -> Self {
        Self { commit: revision.commit.clone(), ..Self::repository(remote) }
    }

    /// A folder of a commit, as git wants it named.
    #[must_use]
    pub fn folder(remote: &Remote, revision: &Revision, folder: &str) -> Self {
        Self { folder: folder.to_owned(), ..Self::commit(remote, revision) }
    }

    /// This and all that it is in.
    fn with_wider(&self) -> [Self; 3] {
        let commit = Self { folder: String::new(), ..self.clone() };
        let repository = Self { commit: String::new(), ..commit.clone() };
        [self.clone(), commit, repository]
    }
}

impl Refused {
    /// Whether this, or what it is in, was not refused a short time ago.
    ///
    /// # Errors
    /// The refusal.
    pub fn check(&self, scope: &Scope) -> Result<(), CheckoutError> {
        let known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let refusals = scope.with_wider().into_iter().filter_map(|scope| known.get(&scope).cloned());
        let mut fresh = refusals.filter(|(since, _)| since.elapsed() < REMEMBERED);
        fresh.next().map_or(Ok(()), |(_, error)| Err(error))
    }

    /// Passes a result on, and remembers it where it is a refusal for size.
    ///
    /// # Errors
    /// Those of the result.
    pub fn note<T>(&self, scope: Scope, result: Result<T, CheckoutError>) -> Result<T, CheckoutError> {
        if let Err(error) = &result
            && error.is_of_size()
        {
            let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            known.retain(|_, (since, _)| since.elapsed() < REMEMBERED);
            // One that is known already is not made longer by being told again.
            if known.len() < MOST
                && let Entry::Vacant(vacant) = known.entry(scope)
            {
                log::info!("refused for {} s: {error}", REMEMBERED.as_secs());
                vacant.insert((Instant::now(), error.clone()));
            }
        }
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::checkout::revision::TrustSource;

    #[test]
    fn a_refusal_holds_for_all_that_is_in_it_and_for_nothing_else() {
        let remote = Remote { location: "https://github.com/lab/arm".to_owned(), protocol: "https" };
        let of = |commit: &str, folder: &str| {
            let (name, trust) = (String::new(), TrustSource::Tip);
            let revision =
                Revision { commit: commit.to_owned(), name, folder: folder.to_owned(), trust, is_whole: false };
            Scope::folder(&remote, &revision, folder)
        };
        let refused = Refused::default();
        let too_large = || Err::<(), _>(CheckoutError::TooMany(1));
        refused.note(of("a", "one"), too_large()).unwrap_err();
        let since = || refused.0.lock().unwrap().get(&of("a", "one")).map(|(since, _)| *since);
        let first = since();
        refused.note(of("a", "one"), refused.check(&of("a", "one"))).unwrap_err();
        assert_eq!(since(), first, "who is refused makes it last no longer");
        assert!(refused.check(&of("a", "one")).is_err());
        for other in [of("a", "two"), of("b", "one"), Scope::repository(&remote), Scope::history(&remote)] {
            refused.check(&other).unwrap();
        }
        refused.note(Scope::history(&remote), too_large()).unwrap_err();
        refused.check(&of("b", "one")).unwrap();
        refused.note(Scope::repository(&remote), Err::<(), _>(CheckoutError::Forge(String::new()))).unwrap_err();
        refused.check(&of("b", "one")).unwrap();
        refused.note(Scope::repository(&remote), too_large()).unwrap_err();
        refused.check(&of("b", "one")).unwrap_err();
    }
}
