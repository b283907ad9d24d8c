//! Short requests by HTTP, and the TLS configuration that they share with WebSockets.

use std::sync::{Arc, LazyLock};
use std::time::Duration;

use awc::Client;
use awc::error::SendRequestError;
use rustls::ClientConfig;
use webots_fleet::shared::domain::Reason;
use webots_fleet::shared::http::tls;

/// Timeout of an answer.
const ANSWER: Duration = Duration::from_secs(20);
/// Size limit of an answer, in bytes.
const LONGEST_ANSWER: usize = 64 << 10;
/// The TLS configuration of requests and WebSockets; the trust store is read once. `None` if TLS can't be set up.
static TLS: LazyLock<Option<Arc<ClientConfig>>> = LazyLock::new(tls::client_config);

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

/// An answer with any status: the page ignores the status too.
pub(crate) struct Answer {
    /// Its body.
    pub(crate) text: String,
    /// Why a request was refused; servers that don't know reasons, such as the original, send none.
    pub(crate) reason: Option<Reason>,
}

/// The answer to a request.
///
/// # Errors
/// Why there is none.
pub(crate) async fn get(http: &Client, url: &str) -> Result<Answer, String> {
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
    let code = answer.headers().get(Reason::HEADER);
    Ok(Answer {
        reason: code.and_then(|code| Reason::of_code(code.to_str().ok()?)),
        text: String::from_utf8_lossy(&body).into_owned(),
    })
}
