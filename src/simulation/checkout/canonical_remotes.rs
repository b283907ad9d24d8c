//! The canonical URLs of repositories: GitLab redirects requests without the ending `.git` to `REPOSITORY.git`.

use std::collections::HashMap;

use parking_lot::Mutex;

use super::mirrors::Remote;

/// Canonical remotes, by [`Remote::key`].
#[derive(Debug, Default)]
pub struct CanonicalRemotes(Mutex<HashMap<String, Remote>>);

/// Number of remotes from which on all are dropped.
const MOST: usize = 1000;

impl CanonicalRemotes {
    /// Records the canonical URL of a remote.
    pub fn insert(&self, remote: Remote) {
        let mut known = self.0.lock();
        if known.len() >= MOST {
            known.clear();
        }
        known.insert(remote.key(), remote);
    }

    /// Returns the remote as its forge spells it.
    pub fn of(&self, remote: Remote) -> Remote {
        let known = self.0.lock();
        known.get(&remote.key()).cloned().unwrap_or(remote)
    }
}
