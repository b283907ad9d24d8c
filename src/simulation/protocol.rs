//! What web clients say on `/client`, and what they are told. Pure.
//!
//! | from the client (JSON) | |
//! |---|---|
//! | `{"start": {"url": WORLD, "mode": "x3d" \| "w3d" \| "mjpeg"}}` | start a simulation |
//! | `{"reset controller": "NAME/FILE"}` | restore a file below `controllers/` |
//!
//! | to the client (text) | |
//! |---|---|
//! | `queue: N` | N clients are ahead in the waiting line |
//! | `loading: TEXT` | what is going on |
//! | `loading: Error: TEXT` | why it failed; the connection is closed after it |
//! | `shutdownTimeout: SECONDS` | the process was launched, and will be closed after so long |
//! | `webots:URL` | Webots is ready there |
//! | `.` | Webots lives |
//! | `reset controller: NAME/FILE` | done |

use serde::Deserialize;

/// What a client asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// A simulation of the world at this URL.
    Start {
        /// As the client wrote it.
        url: String,
        /// How it is shown.
        mode: Mode,
    },
    /// The original state of this file below `controllers/`.
    ResetController(String),
}

/// How a simulation is shown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// A 3D scene, rendered by the browser; the name of R2023b and before.
    #[default]
    X3d,
    /// A 3D scene, rendered by the browser; the name since R2025a.
    W3d,
    /// A video.
    Mjpeg,
}

/// A message that can't be understood; its words are for the client.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "Wrong message: {0}. Allowed are {{\"start\": {{\"url\": ..., \"mode\": \"x3d\", \"w3d\" or \"mjpeg\"}}}} and {{\"reset controller\": \"NAME/FILE\"}}."
)]
pub struct WrongMessage(String);

#[derive(Deserialize)]
struct Wire {
    start: Option<WireStart>,
    #[serde(rename = "reset controller")]
    reset_controller: Option<String>,
}

#[derive(Deserialize)]
struct WireStart {
    url: String,
    #[serde(default)]
    mode: Option<Mode>,
}

impl Request {
    /// Reads a message of a client.
    ///
    /// # Errors
    /// When it is none.
    pub fn parse(text: &str) -> Result<Self, WrongMessage> {
        let wire: Wire = serde_json::from_str(text).map_err(|error| WrongMessage(error.to_string()))?;
        match wire {
            Wire { reset_controller: Some(file), .. } => Ok(Self::ResetController(file)),
            Wire { start: Some(WireStart { url, mode }), .. } => {
                Ok(Self::Start { url, mode: mode.unwrap_or_default() })
            }
            Wire { .. } => Err(WrongMessage("it asks for nothing".to_owned())),
        }
    }
}

/// The heartbeat that is passed on.
pub const HEARTBEAT: &str = ".";

/// Progress, in words.
#[must_use]
pub fn loading(text: &str) -> String {
    format!("loading: {text}")
}

/// Why a simulation failed.
#[must_use]
pub fn error(text: &str) -> String {
    format!("loading: Error: {text}")
}

/// How many clients are ahead.
#[must_use]
pub fn queue(ahead: usize) -> String {
    format!("queue: {ahead}")
}

/// After how many seconds the simulation will be closed.
#[must_use]
pub fn shutdown_timeout(seconds: u64) -> String {
    format!("shutdownTimeout: {seconds}")
}

/// Where Webots is ready.
#[must_use]
pub fn webots(url: &str) -> String {
    format!("webots:{url}")
}

/// A controller's file was restored.
#[must_use]
pub fn reset_controller(file: &str) -> String {
    format!("reset controller: {file}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_read() {
        let start = |mode| Request::Start { url: "https://x".to_owned(), mode };
        let table = [
            (r#"{"start":{"url":"https://x"}}"#, start(Mode::X3d)),
            (r#"{"start":{"url":"https://x","mode":"mjpeg","more":1}}"#, start(Mode::Mjpeg)),
            (r#"{"start":{"url":"https://x","mode":"w3d"}}"#, start(Mode::W3d)),
            (r#"{ "reset controller" : "a/a.py" }"#, Request::ResetController("a/a.py".to_owned())),
        ];
        for (text, request) in table {
            assert_eq!(Request::parse(text), Ok(request), "{text}");
        }
    }

    #[test]
    fn anything_else_is_refused_in_words() {
        let table = [
            ("", "EOF"),
            ("{}", "asks for nothing"),
            (r#"{"start":{}}"#, "missing field `url`"),
            (r#"{"start":{"url":"x","mode":"vr"}}"#, "unknown variant `vr`"),
            (r#"{"start":{"url":5}}"#, "expected a string"),
            ("[1]", "invalid"),
        ];
        for (text, words) in table {
            let error = Request::parse(text).unwrap_err().to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
    }

    #[test]
    fn answers_are_those_of_the_original() {
        assert_eq!(webots("wss://host/2001"), "webots:wss://host/2001");
        assert_eq!(shutdown_timeout(7200), "shutdownTimeout: 7200");
        assert_eq!(error("no"), "loading: Error: no");
        assert_eq!(queue(3), "queue: 3");
    }
}
