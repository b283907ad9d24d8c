//! A page that is loaded again: it comes back to its simulation, whose time has gone on.

use std::time::Duration;

use crate::connection::{Connection, Deadline, Ended, simulated_time, unless_error};

/// How long each step may take.
const STEP: Duration = Duration::from_secs(20);

/// What a client needs to come back.
pub(crate) struct WayBack {
    server: String,
    webots: String,
    token: String,
}

impl WayBack {
    /// Waits for the token, which comes once Webots is ready. `server` and `webots` are where both are.
    ///
    /// # Errors
    /// When none comes: the server knows nothing of coming back, or it is turned off there.
    pub(crate) async fn find(lease: &mut Connection, server: &str, webots: &str) -> Result<Self, Ended> {
        let deadline = Deadline::within(STEP);
        loop {
            if let Some(token) = lease.receive_by(deadline).await?.strip_prefix("resume: ") {
                return Ok(Self { server: server.to_owned(), webots: webots.to_owned(), token: token.to_owned() });
            }
        }
    }

    /// Comes back, and waits until time passes. Returns the connection that keeps the simulation, and the one to Webots.
    ///
    /// # Errors
    /// Why the simulation was not found again.
    pub(crate) async fn go(self, viewer: &str) -> Result<(Connection, Connection), Ended> {
        let deadline = Deadline::within(STEP);
        let mut lease = Connection::open(&format!("{}/client", self.server)).await?;
        lease.say(&serde_json::json!({ "resume": self.token }).to_string()).await?;
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
        // Any other first word would make it pause.
        stream.say(&format!("{viewer};broadcast")).await?;
        let mut first = None;
        loop {
            match (first, simulated_time(&unless_error(stream.receive_by(deadline).await?)?)) {
                (Some(first), Some(time)) if time > first => return Ok((lease, stream)),
                (None, Some(time)) => first = Some(time),
                _ => {}
            }
        }
    }
}
