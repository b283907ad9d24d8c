//! The messages between a session server and a simulation server about the simulations that run there. They share the
//! WebSocket of the messages about slots (`slot_link`).
//!
//! After [`Follow`], the simulation server sends a [`RosterUpdate`] with all its simulations, and then what changes.
//! Each [`StopOrder`] is answered with [`Stopped`].

use serde::{Deserialize, Serialize};

use super::KeepReady;
use super::slot_link::{Offers, Wishes};

/// A message of a session server.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum ToSimulationServer {
    /// See there.
    Follow(Follow),
    /// See there.
    Stop(StopOrder),
    /// Without a tag.
    #[serde(untagged)]
    KeepReady(KeepReady),
    /// Without a tag.
    #[serde(untagged)]
    Wishes(Wishes),
}

/// A message of a simulation server.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum ToSessionServer {
    /// See [`RosterUpdate`].
    Roster(RosterUpdate),
    /// See there.
    Stopped(Stopped),
    /// Without a tag.
    #[serde(untagged)]
    Offers(Offers),
}

/// Asks for all simulations, and then for what changes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Follow {
    /// Whether somebody looks at the figures, which cost the simulation server a measurement.
    pub figures: bool,
    /// The URL of the page that lists the simulations of all servers.
    pub page: String,
}

/// What has changed since the last update.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct RosterUpdate {
    /// Whether this replaces all that was sent before.
    pub all: bool,
    /// The simulations that are new, or have changed.
    pub simulations: Vec<SimulationReport>,
    /// The ids of those that have ended.
    pub ended: Vec<String>,
}

/// A simulation, as its server reports it to the session servers of its fleet. Times are in seconds since 1970.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct SimulationReport {
    /// Its id; unique on its server.
    pub id: String,
    /// The URL of its world.
    pub world: String,
    /// The user whom a trusted reverse proxy names.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// The name that its client has chosen; it is not checked.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub label: Option<String>,
    /// Its state.
    pub state: Stage,
    /// When its client requested it.
    pub since: u64,
    /// Seconds for which its client has waited for the slot, once it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waited: Option<f64>,
    /// When it stops waiting for its disconnected client.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub away_until: Option<u64>,
    /// Percent of one core that it uses, rounded to five; only while somebody looks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu: Option<u32>,
    /// Simulated seconds per second, in percent rounded to five; only if its stream is relayed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_time: Option<u32>,
}

/// The states of a simulation, as pages and programs see them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// In the queue.
    Queued,
    /// Its project is checked out.
    CheckingOut,
    /// Webots is starting.
    Launching,
    /// Webots runs, the simulation is paused.
    Idle,
    /// The simulation runs.
    Running,
    /// Webots is ending.
    Stopping,
}

/// Stops simulations.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopOrder {
    /// Identifies the order on its connection.
    pub number: u64,
    /// The ids of the simulations.
    pub ids: Vec<String>,
    /// The reason for their clients; it may be empty.
    pub reason: String,
    /// Who stops them, for the log.
    pub by: String,
}

/// What has come of an order.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stopped {
    /// The number of the order.
    pub number: u64,
    /// The ids of the simulations that are being stopped. The others had ended.
    pub ids: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_about_slots_have_no_tag() {
        let wishes = serde_json::to_string(&ToSimulationServer::Wishes(Wishes::default())).unwrap();
        assert_eq!(wishes, serde_json::to_string(&Wishes::default()).unwrap());
        let offers = r#"{"number": 1, "offers": [], "free": 2}"#;
        assert!(matches!(
            serde_json::from_str(offers).unwrap(),
            ToSessionServer::Offers(Offers { free: 2, .. })
        ));
        let follow = r#"{"follow": {"figures": true, "page": "http://x/class"}}"#;
        assert!(matches!(
            serde_json::from_str(follow).unwrap(),
            ToSimulationServer::Follow(Follow { figures: true, .. })
        ));
    }
}
