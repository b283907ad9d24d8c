//! The session server as a web page uses it.

use std::sync::{Arc, LazyLock};
use std::time::Duration;

use awc::Client;
use awc::error::SendRequestError;
use rustls::ClientConfig;
use url::Url;
use webots_fleet::shared::http::tls;

use crate::connection::{Connection, Ended};
use crate::words::{excerpt, line};

/// Timeout of an answer.
const ANSWER: Duration = Duration::from_secs(20);
/// Size limit of an answer, in bytes.
const LONGEST_ANSWER: usize = 64 << 10;
/// The TLS configuration of requests and WebSockets; the trust store is read once. `None` if TLS can't be set up.
static TLS: LazyLock<Option<Arc<ClientConfig>>> = LazyLock::new(tls::client_config);

/// A session server.
#[derive(Clone)]
pub(crate) struct Session {
    url: Url,
    http: Client,
}

impl Session {
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
        let text = get(&self.http, &url).await?;
        let load = text.trim().parse::<f64>();
        load.map_err(|_| format!("{url} is no load but {}: no session server", excerpt(&text)))?;
        // Simulation servers have a load too, but nothing at `/`.
        match Connection::open(&self.availability_url()).await {
            Ok(availability) => availability.close().await,
            Err(Ended::Unreachable(url, why)) if why.contains("404") => {
                return Err(format!(
                    "{url} tells no availability ({why}): no session server, maybe a simulation server"
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
        format!("{}/", to_web_socket(&self.base()))
    }

    /// Requests a simulation server for a world: `ws://HOST:PORT` or `wss://HOST/PORT`.
    ///
    /// # Errors
    /// The text that was received instead.
    pub(crate) async fn simulation_server(&self, world: &str) -> Result<String, String> {
        // The page inserts the world verbatim, and its browser encodes characters that a URL must not contain, such as
        // spaces.
        let url = format!("{}/session?url={world}", self.base());
        let url = Url::parse(&url).map_err(|error| format!("{url} is no URL: {error}"))?;
        let answer = get(&self.http, url.as_str()).await?;
        let answer = line(answer.trim());
        let is_one = answer.starts_with("ws://") || answer.starts_with("wss://");
        if is_one {
            Ok(answer.trim_end_matches('/').to_owned())
        } else {
            Err(answer)
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

/// The TLS configuration for `https://` and `wss://`.
pub(crate) fn encryption() -> Option<Arc<ClientConfig>> {
    TLS.clone()
}

/// A client for short answers, also from `https://` servers.
pub(crate) fn client() -> Client {
    let connector = awc::Connector::new();
    let connector = match encryption() {
        Some(config) => connector.rustls_0_23(config),
        None => connector,
    };
    Client::builder().connector(connector).timeout(ANSWER).finish()
}

/// The body of an answer with any status: the page ignores the status too.
///
/// # Errors
/// Why there is none.
pub(crate) async fn get(http: &Client, url: &str) -> Result<String, String> {
    let unreachable = |error: SendRequestError| {
        let why = tls::reason(&error).unwrap_or_else(|| error.to_string());
        format!("{url} can't be reached: {why}")
    };
    let mut answer = http.get(url).send().await.map_err(unreachable)?;
    let body = answer
        .body()
        .limit(LONGEST_ANSWER)
        .await
        .map_err(|error| format!("{url} can't be read: {error}"))?;
    Ok(String::from_utf8_lossy(&body).into_owned())
}

/// `ws://...` of `http://...`, `wss://...` of `https://...`.
pub(crate) fn to_web_socket(url: &str) -> String {
    url.replacen("http", "ws", 1)
}

/// `http://...` of `ws://...`, `https://...` of `wss://...`.
pub(crate) fn to_http(url: &str) -> String {
    url.replacen("ws", "http", 1)
}
