//! What a simulation server tells in `GET /status`, the one page that both servers know.

use serde::{Deserialize, Serialize};

use super::admission::Rules;
use super::load::Load;
use super::project_url::ProjectUrl;
use super::repositories::{UrlPrefix, any_covers, any_may_cover};
use crate::shared::config::{object, optional_object};

/// The part of a simulation server's `/status` that decides where clients go.
///
/// Only `load` is required: everything else has a default that means 'not said', so that an older or another
/// server's page is understood as far as it goes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Dispatch {
    /// Percent, the mean of the last five seconds.
    pub load: Load,
    /// The server's version.
    #[serde(default)]
    pub version: String,
    /// The simulations of the server, where it counts them.
    #[serde(default, deserialize_with = "optional_object")]
    pub instances: Option<Instances>,
    /// Whose worlds the server runs at any load.
    #[serde(default)]
    pub allowed_repositories: Vec<UrlPrefix>,
    /// Whose worlds it never runs.
    #[serde(default)]
    pub blocked_repositories: Vec<UrlPrefix>,
    /// The highest load, in percent, at which worlds of others may run; 0: never.
    #[serde(default)]
    pub share_idle_time: f64,
    /// Whether the server can run worlds of others in containers.
    #[serde(default)]
    pub docker: Option<bool>,
    /// Whether the server takes no new clients because it is to end.
    #[serde(default)]
    pub draining: bool,
}

/// How many simulations a server has, by their state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Instances {
    /// Clients in the waiting line.
    pub queued: u32,
    /// Checking out or launching.
    pub starting: u32,
    /// Webots runs, its simulation is paused.
    pub idle: u32,
    /// Webots runs, and so does its simulation.
    pub running: u32,
    /// How many simulations fit.
    pub places: u32,
    /// Clients that asked for a start since the server began; it only grows.
    pub arrivals: u64,
}

impl Instances {
    /// Clients that hold a place or wait for one.
    #[must_use]
    pub fn present(&self) -> u32 {
        // Another server's numbers may be anything.
        [self.starting, self.idle, self.running].into_iter().fold(self.queued, u32::saturating_add)
    }
}

impl Dispatch {
    /// Reads the page.
    ///
    /// # Errors
    /// When it is something else.
    pub fn parse(page: &[u8]) -> serde_json::Result<Self> {
        let mut json = serde_json::Deserializer::from_slice(page);
        let dispatch = object(&mut json)?;
        json.end().map(|()| dispatch)
    }

    /// What is known of a server that tells its load alone.
    #[must_use]
    pub fn load_only(load: Load) -> Self {
        Self {
            load,
            version: String::new(),
            instances: None,
            allowed_repositories: Vec::new(),
            blocked_repositories: Vec::new(),
            share_idle_time: 0.0,
            docker: None,
            draining: false,
        }
    }

    /// Whether the server will run this world, by what it says of itself.
    ///
    /// A server that doesn't say whether it has docker is another's: it is taken to run every world that it does not
    /// rule out, as the original's session server takes it.
    #[must_use]
    pub fn accepts(&self, world: &ProjectUrl) -> bool {
        let Some(docker) = self.docker else {
            let blocked = any_may_cover(&self.blocked_repositories, world);
            let open = self.allowed_repositories.is_empty() || self.share_idle_time > 0.0;
            return !blocked && (open || any_covers(&self.allowed_repositories, world));
        };
        let rules = Rules {
            allowed: self.allowed_repositories.clone(),
            blocked: self.blocked_repositories.clone(),
            docker,
            share_idle_time: self.share_idle_time,
        };
        rules.admit(world, self.load).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_is_sent_only_worlds_that_it_will_run() {
        let lab = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap();
        let other = ProjectUrl::parse("https://github.com/other/arm/blob/main/worlds/a.wbt").unwrap();
        let table = [
            (r#"{"load": 1}"#, true, true, "it says nothing"),
            (
                r#"{"load": 1, "allowedRepositories": ["https://github.com/lab"]}"#,
                true,
                false,
                "Python, shares nothing",
            ),
            (
                r#"{"load": 1, "allowedRepositories": ["https://github.com/lab"], "shareIdleTime": 50}"#,
                true,
                true,
                "Python",
            ),
            (r#"{"load": 1, "docker": false}"#, false, false, "ours, allows nobody"),
            (r#"{"load": 1, "docker": false, "allowedRepositories": ["https://github.com/lab"]}"#, true, false, "ours"),
            (
                r#"{"load": 60, "docker": true, "shareIdleTime": 50, "allowedRepositories": ["https://github.com/lab"]}"#,
                true,
                false,
                "busy",
            ),
            (
                r#"{"load": 40, "docker": true, "shareIdleTime": 50, "blockedRepositories": ["https://github.com/lab"]}"#,
                false,
                true,
                "blocked",
            ),
        ];
        for (text, runs_lab, runs_other, why) in table {
            let status: Dispatch = serde_json::from_str(text).unwrap();
            assert_eq!((status.accepts(&lab), status.accepts(&other)), (runs_lab, runs_other), "{why}");
        }
    }
}
