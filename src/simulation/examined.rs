//! Which cached repositories were found to be in order a short time ago: to read one of them takes long, and the next
//! client whose world can't be had must not make the server read it again.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use tokio::sync::Mutex;

use super::git::Git;

/// The repositories that were examined; one for the whole server, which examines one at a time.
#[derive(Debug, Default)]
pub struct Examined(Mutex<HashMap<PathBuf, Instant>>);

/// So long a repository that was in order is taken to be so.
const TRUST: Duration = Duration::from_mins(3);

impl Examined {
    /// Whether everything is in order in a repository, or was within the last minutes.
    pub async fn is_sound(&self, git: &Git, repository: &Path) -> bool {
        let mut examined = self.0.lock().await;
        examined.retain(|_, when| when.elapsed() < TRUST);
        if examined.contains_key(repository) {
            return true;
        }
        let is_sound = git.is_sound(repository).await;
        if is_sound {
            examined.insert(repository.to_owned(), Instant::now());
        }
        is_sound
    }
}
