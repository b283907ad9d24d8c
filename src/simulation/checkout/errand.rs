//! What is fetched for whom, and the git commands that this takes.

use std::ffi::OsString;
use std::path::Path;

use tokio::sync::watch;

use super::git::Call;
use super::mirrors::Remote;
use crate::shared::domain::ProjectUrl;

/// What is fetched for whom.
#[derive(Debug, Clone, Copy)]
pub struct Errand<'job> {
    /// The world that is wanted.
    pub world: &'job ProjectUrl,
    /// Where its repository is.
    pub remote: &'job Remote,
    /// Hears each step in words.
    pub progress: &'job watch::Sender<String>,
}

impl Errand<'_> {
    /// Tells that something else must be done first.
    pub fn tell_wait(self) {
        self.progress.send_replace(format!("waiting while what is cached of {} is tidied up", self.world.repository()));
    }
}

/// A git command on a cached repository.
#[must_use]
pub fn call<'call>(remote: &Remote, repository: &'call Path, arguments: Vec<OsString>) -> Call<'call> {
    Call { repository, arguments, protocol: remote.protocol, environment: Vec::new() }
}
