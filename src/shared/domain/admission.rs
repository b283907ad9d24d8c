//! Whether a world may run on a server at its current load. Pure.

use super::load::Load;
use super::project_url::ProjectUrl;
use super::reason::{Failure, Reason};
use super::url_prefix::UrlPrefix;

/// The admission rules of a server.
#[derive(Debug, Clone)]
pub struct AdmissionRules<Prefixes = Vec<UrlPrefix>> {
    /// Repositories whose worlds run at any load.
    pub allowed: Prefixes,
    /// Repositories whose worlds never run.
    pub blocked: Prefixes,
    /// Whether worlds of other repositories can run in containers.
    pub docker: bool,
    /// The highest load, in percent, at which worlds of other repositories run; 0: never.
    pub share_idle_time: f64,
}

/// Why a world may not run, as text for the client. It is formatted only on demand, because a session server checks the
/// rules of every server.
#[derive(Debug, PartialEq, thiserror::Error)]
pub enum AdmissionError<'world> {
    /// Its repository is blocked.
    #[error("Cannot run simulation from blocked repository: {}", .0.repository())]
    Blocked(&'world ProjectUrl),
    /// Its repository is not allowed, and the server does not run containers.
    #[error(
        "Docker not enabled: cannot host simulations from repositories outside of those that this simulation server allows, and {} is not one of them",
        .0.repository()
    )]
    NotAllowed(&'world ProjectUrl),
    /// Its repository is not allowed, and the server does not share idle time.
    #[error("This simulation server is not configured to share idle time: it does not allow {}", .0.repository())]
    NotShared(&'world ProjectUrl),
    /// Its repository is allowed only at a lower load.
    #[error(
        "Cannot share idle time when current load is above threshold: {load:.0} % are more than {threshold} %. Try again later"
    )]
    Busy {
        /// Percent.
        load: f64,
        /// Percent.
        threshold: f64,
    },
}

impl From<AdmissionError<'_>> for Failure {
    fn from(error: AdmissionError<'_>) -> Self {
        let reason = match error {
            AdmissionError::Blocked(_) => Reason::RepositoryBlocked,
            AdmissionError::NotAllowed(_) | AdmissionError::NotShared(_) => Reason::RepositoryNotAllowed,
            AdmissionError::Busy { .. } => Reason::NoIdleTime,
        };
        Self::new(reason, error.to_string())
    }
}

impl<Prefixes: AsRef<[UrlPrefix]>> AdmissionRules<Prefixes> {
    /// Whether a world may run at this load. A world of a blocked repository never may; the original checks the blocked
    /// repositories only for worlds that are not allowed.
    ///
    /// # Errors
    /// Why it may not.
    pub fn admit<'world>(&self, world: &'world ProjectUrl, load: Load) -> Result<(), AdmissionError<'world>> {
        if self.blocked.as_ref().iter().any(|prefix| prefix.covers(world)) {
            return Err(AdmissionError::Blocked(world));
        }
        if self.allowed.as_ref().iter().any(|prefix| prefix.covers(world)) {
            return Ok(());
        }
        if !self.docker {
            return Err(AdmissionError::NotAllowed(world));
        }
        if self.share_idle_time <= 0.0 {
            return Err(AdmissionError::NotShared(world));
        }
        if load.percent() > self.share_idle_time {
            return Err(AdmissionError::Busy {
                load: load.percent(),
                threshold: self.share_idle_time,
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_world_runs_by_its_repository_and_the_load() {
        let prefixes = |texts: &[&str]| {
            texts
                .iter()
                .map(|text| UrlPrefix::try_from((*text).to_owned()).unwrap())
                .collect::<Vec<_>>()
        };
        let rules = |docker, share_idle_time| AdmissionRules {
            allowed: prefixes(&["https://github.com/lab"]),
            blocked: prefixes(&["https://github.com/lab/secret", "https://github.com/Evil"]),
            docker,
            share_idle_time,
        };
        let table = [
            ("lab/arm", true, 50.0, 99.0, "", "allowed at any load"),
            ("LAB/arm", false, 0.0, 0.0, "", "Git hosts ignore case"),
            ("lab/secret", true, 50.0, 0.0, "blocked", "blocked even where allowed"),
            ("evil/x", true, 50.0, 0.0, "blocked", "no way around by small letters"),
            (
                "lab-evil/arm",
                false,
                50.0,
                0.0,
                "Docker",
                "a like beginning is no prefix",
            ),
            ("other/x", false, 50.0, 0.0, "Docker", "others need a container"),
            (
                "other/x",
                true,
                0.0,
                0.0,
                "not configured to share",
                "nothing is shared",
            ),
            ("other/x", true, 50.0, 50.0, "", "idle enough"),
            ("other/x", true, 50.0, 50.1, "above threshold", "too busy"),
        ];
        for (repository, docker, share, load, words, why) in table {
            let world = ProjectUrl::parse(&format!("https://github.com/{repository}/blob/main/worlds/a.wbt")).unwrap();
            let verdict = rules(docker, share).admit(&world, Load::try_from(load).unwrap());
            let text = verdict.map_or_else(|refusal| refusal.to_string(), |()| String::new());
            assert!(
                if words.is_empty() {
                    text.is_empty()
                } else {
                    text.contains(words)
                },
                "{why}: {text:?}"
            );
        }
    }
}
