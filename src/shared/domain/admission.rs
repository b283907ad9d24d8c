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

/// On what terms a server runs a world.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Admission {
    /// At any load: its repository is one of those that the server allows.
    Dedicated,
    /// While its load is low (`shareIdleTime`).
    Shared,
}

impl<Prefixes: AsRef<[UrlPrefix]>> AdmissionRules<Prefixes> {
    /// Whether a world may run at this load. A world of a blocked repository never may; the original checks the blocked
    /// repositories only for worlds that are not allowed.
    ///
    /// # Errors
    /// Why it may not.
    pub fn admit(&self, world: &ProjectUrl, load: Load) -> Result<Admission, Failure> {
        self.check(world, load)
            .map_err(|reason| self.failure(reason, world, load))
    }

    /// As [`Self::admit`], without a text: a session server checks the rules of every server.
    ///
    /// # Errors
    /// Why it may not.
    pub fn check(&self, world: &ProjectUrl, load: Load) -> Result<Admission, Reason> {
        let covered = |prefixes: &Prefixes| prefixes.as_ref().iter().any(|prefix| prefix.covers(world));
        if covered(&self.blocked) {
            Err(Reason::RepositoryBlocked)
        } else if covered(&self.allowed) {
            Ok(Admission::Dedicated)
        } else if !self.docker || self.share_idle_time <= 0.0 {
            Err(Reason::RepositoryNotAllowed)
        } else if load.percent() > self.share_idle_time {
            Err(Reason::NoIdleTime)
        } else {
            Ok(Admission::Shared)
        }
    }

    fn failure(&self, reason: Reason, world: &ProjectUrl, load: Load) -> Failure {
        let repository = world.repository();
        let threshold = self.share_idle_time;
        let message = match reason {
            Reason::RepositoryBlocked => format!("Cannot run simulation from blocked repository: {repository}"),
            Reason::NoIdleTime => format!(
                "Cannot share idle time when current load is above threshold: {:.0} % are more than {threshold} %. Try \
                 again later",
                load.percent()
            ),
            _ if !self.docker => format!(
                "Docker not enabled: cannot host simulations from repositories outside of those that this simulation \
                 server allows, and {repository} is not one of them"
            ),
            _ => format!("This simulation server is not configured to share idle time: it does not allow {repository}"),
        };
        Failure::new(reason, message)
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
            let text = verdict.map_or_else(|refusal| refusal.to_string(), |_| String::new());
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
