//! The session server as a web page uses it.

use awc::Client;
use tokio_tungstenite::tungstenite::http::StatusCode;
use url::Url;
use webots_fleet::shared::domain::Blame;

use crate::connection::{Connection, Ended};
use crate::http::{Answer, client, get};
use crate::words::{excerpt, line};

/// Why no simulation server was chosen.
pub(crate) struct NoServer {
    /// What was received instead.
    pub(crate) answer: String,
    /// Whether the fleet is full, which is temporary.
    pub(crate) is_full: bool,
}

/// What the original answers if its fleet is full; it sends no code.
const FULL: &str = "Error: no simulation server available at the moment.";

/// A session server.
#[derive(Clone)]
pub(crate) struct SessionServer {
    url: Url,
    http: Client,
}

impl SessionServer {
    /// The session server at this URL.
    pub(crate) fn new(url: &Url) -> Self {
        Self {
            url: url.clone(),
            http: client(),
        }
    }

    /// Checks that this is a session server.
    ///
    /// # Errors
    /// What was received instead of a load and of the availability.
    pub(crate) async fn answers(&self) -> Result<(), String> {
        let url = format!("{}/load", self.base());
        let text = get(&self.http, &url).await?.text;
        let load = text.trim().parse::<f64>();
        load.map_err(|_| format!("{url} is no load but {}: no session server", excerpt(&text)))?;
        // Simulation servers have a load too, but nothing at `/`.
        match Connection::open(&self.availability_url()).await {
            Ok(availability) => availability.close().await,
            Err(Ended::Refused(url, status)) if status == StatusCode::NOT_FOUND => {
                return Err(format!(
                    "{url} tells no availability ({status}): no session server, maybe a simulation server"
                ));
            }
            // Later steps report this error.
            Err(_) => {}
        }
        Ok(())
    }

    /// Waits until the session server reports that a simulation server can take a client. Its WebSocket sends that at
    /// once, and then on each change.
    ///
    /// # Errors
    /// When the connection has ended.
    pub(crate) async fn until_available(&self) -> Result<(), Ended> {
        let mut availability = Connection::open(&self.availability_url()).await?;
        while availability.receive().await? != "1" {}
        availability.close().await;
        Ok(())
    }

    /// The URL of the WebSocket that sends the availability: in the original it is `/`.
    pub(crate) fn availability_url(&self) -> String {
        format!("{}/", self.base().replacen("http", "ws", 1))
    }

    /// Requests a simulation server for a world: `ws://HOST:PORT` or `wss://HOST/PORT`.
    ///
    /// # Errors
    /// Why there is none.
    pub(crate) async fn simulation_server(&self, world: &str) -> Result<String, NoServer> {
        let none = |answer| NoServer { answer, is_full: false };
        // The page inserts the world verbatim, and its browser encodes characters that a URL must not contain, such as
        // spaces.
        let url = format!("{}/session?url={world}", self.base());
        let url = Url::parse(&url).map_err(|error| none(format!("{url} is no URL: {error}")))?;
        let Answer { text, reason } = get(&self.http, url.as_str()).await.map_err(none)?;
        let answer = line(text.trim());
        if answer.starts_with("ws://") || answer.starts_with("wss://") {
            return Ok(answer.trim_end_matches('/').to_owned());
        }
        Err(NoServer {
            is_full: reason.map_or(answer == FULL, |reason| reason.blame() == Blame::Fleet),
            answer,
        })
    }

    /// Waits for a simulation server in the line. Returns its URL and the pass for it, if it has reserved a slot.
    /// `place` receives the number of clients ahead.
    ///
    /// # Errors
    /// The text that was received instead, or why the connection has ended.
    pub(crate) async fn turn(
        &self,
        world: &str,
        mut place: impl FnMut(u32),
    ) -> Result<(String, Option<String>), String> {
        let url = format!("{}/session", self.base().replacen("http", "ws", 1));
        let mut line = Connection::open(&url).await.map_err(|ended| ended.to_string())?;
        let request = serde_json::json!({"url": world, "wait": true});
        line.say(&request.to_string())
            .await
            .map_err(|ended| ended.to_string())?;
        let mut pass = None;
        loop {
            let text = line.receive().await.map_err(|ended| ended.to_string())?;
            match text.split_once(": ") {
                Some(("queue", ahead)) => ahead.parse().map_or((), &mut place),
                Some(("pass", given)) => pass = Some(given.to_owned()),
                Some(("Error", _)) => return Err(text),
                _ if text.starts_with("ws://") || text.starts_with("wss://") => {
                    line.close().await;
                    return Ok((text.trim_end_matches('/').to_owned(), pass));
                }
                _ => {}
            }
        }
    }

    fn base(&self) -> String {
        self.url
            .as_str()
            .trim_end_matches('/')
            .trim_end_matches("/session")
            .to_owned()
    }
}
