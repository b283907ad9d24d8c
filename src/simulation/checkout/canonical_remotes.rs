//! How forges spell their repositories: GitLab sends to `REPOSITORY.git` who asks without the ending.

use std::collections::HashMap;

use parking_lot::Mutex;

use super::mirrors::Remote;

/// Remotes as their forges spell them, by their keys.
#[derive(Debug, Default)]
pub struct CanonicalRemotes(Mutex<HashMap<String, Remote>>);

/// How many are remembered.
const MOST: usize = 1000;

impl CanonicalRemotes {
    /// Remembers how a forge spells a remote.
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
