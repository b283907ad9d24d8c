//! A reloaded page: it resumes its simulation, whose time has continued.

use std::time::Duration;

use crate::connection::{Connection, Deadline, Ended, simulated_time, unless_error};

/// Timeout of each step.
const STEP: Duration = Duration::from_secs(20);

/// What a client needs to resume its simulation.
pub(crate) struct WayBack {
    server: String,
    webots: String,
    token: String,
}

impl WayBack {
    /// Waits for the token, which is sent once Webots is ready. `server` and `webots` are their URLs.
    ///
    /// # Errors
    /// When no token is received: the server does not support resuming, or has turned it off.
    pub(crate) async fn find(lease: &mut Connection, server: &str, webots: &str) -> Result<Self, Ended> {
        let deadline = Deadline::within(STEP);
        loop {
            if let Some(token) = lease.receive_by(deadline).await?.strip_prefix("resume: ") {
                return Ok(Self {
                    server: server.to_owned(),
                    webots: webots.to_owned(),
                    token: token.to_owned(),
                });
            }
        }
    }

    /// Resumes the simulation, and waits until its time passes. Returns the connection that owns it, and the one to
    /// Webots.
    ///
    /// # Errors
    /// Why the simulation could not be resumed.
    pub(crate) async fn go(self, viewer: &str) -> Result<(Connection, Connection), Ended> {
        let deadline = Deadline::within(STEP);
        let mut lease = Connection::open(&format!("{}/client", self.server)).await?;
        lease
            .say(&serde_json::json!({ "resume": self.token }).to_string())
            .await?;
        loop {
            let text = lease.receive_by(deadline).await?;
            if let Some(why) = text.strip_prefix("loading: Error: ") {
                return Err(Ended::Fault(why.to_owned()));
            }
            if text.starts_with("webots:") {
                break;
            }
        }
        let mut stream = Connection::open_scene(&format!("{}/", self.webots.trim_end_matches('/'))).await?;
        // Without `;broadcast` the simulation would pause.
        stream.say(&format!("{viewer};broadcast")).await?;
        let mut first = None;
        loop {
            match (
                first,
                simulated_time(&unless_error(stream.receive_by(deadline).await?)?),
            ) {
                (Some(first), Some(time)) if time > first => return Ok((lease, stream)),
                (None, Some(time)) => first = Some(time),
                _ => {}
            }
        }
    }
}
