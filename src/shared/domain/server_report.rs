//! A simulation server's report: the part of `GET /status` that both servers know.

use serde::{Deserialize, Serialize};

use super::admission::{Admission, AdmissionRules};
use super::load::Load;
use super::project_url::ProjectUrl;
use super::ready::{self, ReadyStatus, View};
use super::reason::Reason;
use super::url_prefix::UrlPrefix;
use crate::shared::text::one_line;

/// The part of a simulation server's `/status` that the session server uses to place clients.
///
/// Only `load` is required. Every other field has a default for 'not reported', so that the report of an older server,
/// or of a Python one, can be parsed too.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct ServerReport {
    /// Mean load of the last five seconds, in percent.
    pub load: Load,
    /// The server's version; empty if it is not reported.
    #[serde(default)]
    pub version: String,
    /// Simulations by state; `None` if the server does not report them.
    #[serde(default)]
    pub instances: Option<Instances>,
    /// Repositories whose worlds the server runs at any load.
    #[serde(default, deserialize_with = "prefixes")]
    pub allowed_repositories: Vec<UrlPrefix>,
    /// Repositories whose worlds it never runs.
    #[serde(default, deserialize_with = "prefixes")]
    pub blocked_repositories: Vec<UrlPrefix>,
    /// The highest load, in percent, at which other worlds may run; 0: never.
    #[serde(default)]
    pub share_idle_time: f64,
    /// Whether the server can run other worlds in containers.
    #[serde(default)]
    pub docker: Option<bool>,
    /// Whether the server accepts no new clients because it is about to stop.
    #[serde(default)]
    pub draining: bool,
    /// Whether the server reserves slots for session servers that have its `fleetKey`.
    #[serde(default)]
    pub reserves: bool,
    /// Number of consecutive failed starts of which the server is the cause.
    #[serde(default)]
    pub failed_starts: u32,
    /// Why the server can't start simulations; `None` if it can.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
    /// What it keeps ready for clients.
    #[serde(default, deserialize_with = "ready::lenient")]
    pub ready: Vec<ReadyStatus>,
}

/// Number of simulations of a server by state.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Instances {
    /// Clients in the queue.
    pub queued: u32,
    /// Checking out or launching.
    pub starting: u32,
    /// Webots runs, and its simulation is paused.
    pub idle: u32,
    /// Webots runs, and so does its simulation.
    pub running: u32,
    /// Number of slots.
    #[serde(rename = "places")]
    pub slots: u32,
    /// Clients that have requested a start since the server started; it only grows.
    pub arrivals: u64,
    /// Slots that are reserved for clients with a pass.
    pub reserved: u32,
    /// Slots that have become free since the server started; it only grows.
    pub freed: u64,
    /// Simulations that are kept ready without a client, in any state. They yield their slots to clients, and count
    /// nowhere else.
    pub spare: u32,
}

/// Ignores prefixes that this version can't parse: the server that reports them enforces them itself.
fn prefixes<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Vec<UrlPrefix>, D::Error> {
    let texts = Vec::<String>::deserialize(deserializer)?;
    Ok(texts
        .into_iter()
        .filter_map(|text| UrlPrefix::try_from(text).ok())
        .collect())
}

impl Instances {
    /// Adds those that another process of the same server has.
    pub fn add(&mut self, other: &Self) {
        for (own, others) in [
            (&mut self.queued, other.queued),
            (&mut self.starting, other.starting),
            (&mut self.idle, other.idle),
            (&mut self.running, other.running),
            (&mut self.reserved, other.reserved),
            (&mut self.spare, other.spare),
        ] {
            *own = own.saturating_add(others);
        }
    }

    /// Clients that hold a slot or wait for one.
    pub fn present(&self) -> u32 {
        // Numbers that another server reports may be arbitrarily large.
        [self.starting, self.idle, self.running]
            .into_iter()
            .fold(self.queued, u32::saturating_add)
    }
}

impl ServerReport {
    /// Reads the JSON of `/status`.
    ///
    /// # Errors
    /// When it is not a JSON object with a `load`.
    pub fn parse(page: &[u8]) -> serde_json::Result<Self> {
        let report: Self = serde_json::from_slice(page)?;
        let problem = report.problem.as_deref().map(one_line);
        Ok(Self {
            version: one_line(&report.version),
            problem,
            ..report
        })
    }

    /// Number of simulations of this world that a client can take at once.
    pub fn ready(&self, world: &ProjectUrl, view: View) -> u32 {
        let matching = self.ready.iter().filter(|one| one.mode == view && one.world == *world);
        matching.map(|one| one.ready).fold(0, u32::saturating_add)
    }

    /// The report of a server that has only `/load`.
    pub fn load_only(load: Load) -> Self {
        Self {
            load,
            ..Self::default()
        }
    }

    /// Whether by both reports the server accepts the same worlds on the same terms.
    pub fn has_rules_of(&self, other: &Self) -> bool {
        let rules = |report: &Self| {
            let has_idle_time = report.load.percent() <= report.share_idle_time;
            (report.docker, report.share_idle_time.to_bits(), has_idle_time)
        };
        rules(self) == rules(other)
            && self.allowed_repositories == other.allowed_repositories
            && self.blocked_repositories == other.blocked_repositories
    }

    /// Whether the server accepts this world at this load, by this report.
    ///
    /// A report without `docker` comes from a Python server. The Python session server expects such a server to run
    /// every world that its report does not exclude, and so does this one.
    ///
    /// # Errors
    /// Why it does not.
    pub fn check(&self, world: &ProjectUrl, load: Load) -> Result<Admission, Reason> {
        let is_open = self.allowed_repositories.is_empty() || self.share_idle_time > 0.0;
        let share_idle_time = match self.docker {
            Some(_) => self.share_idle_time,
            None if is_open => f64::INFINITY,
            None => 0.0,
        };
        let rules = AdmissionRules {
            allowed: self.allowed_repositories.as_slice(),
            blocked: self.blocked_repositories.as_slice(),
            docker: self.docker.unwrap_or(true),
            share_idle_time,
        };
        rules.check(world, load)
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
            (
                r#"{"load": 1, "docker": false, "allowedRepositories": ["https://github.com/lab"]}"#,
                true,
                false,
                "ours",
            ),
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
            let status: ServerReport = serde_json::from_str(text).unwrap();
            let runs = |world| status.check(world, status.load).is_ok();
            assert_eq!((runs(&lab), runs(&other)), (runs_lab, runs_other), "{why}");
        }
    }
}
