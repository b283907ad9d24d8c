//! The messages of the WebSocket `/client`. Pure.
//!
//! | from the client (JSON) | |
//! |---|---|
//! | `{"start": {"url": WORLD, "mode": "x3d" \| "w3d" \| "mjpeg", "resumable": true, "early": true, "name": NAME, "pass": PASS}}` | start a simulation; `resumable`: its client may resume it, with `early` from the first moment; `name`: what the client calls itself; `pass`: for a slot that is reserved for it |
//! | `{"resume": TOKEN}` | resume a simulation |
//! | `{"keep": true}` | keep a paused simulation: its idle timeout begins again |
//! | `{"reset controller": "NAME/FILE"}` | restore a file below `controllers/` |
//! | any other JSON | ignored, as the Python server does: old pages send it |
//!
//! | to the client (text) | |
//! |---|---|
//! | `session: ID` | the id of the simulation, for the administrator |
//! | `queue: N` | N clients are ahead in the queue |
//! | `ide: enable` | the project has an editor, on Webots' port + 500 |
//! | `type:TYPE` | the project's type in its `webots.yml` |
//! | `progress: {"step": STEP, "percent": N, "text": TEXT}` | the same for programs, before the next |
//! | `loading: TEXT` | progress |
//! | `reason: {"code": CODE, "blame": WHO, "retry": WHERE, "message": TEXT, "output": TEXT}` | the same for programs, before the next |
//! | `loading: Error: TEXT` | why the simulation failed; the connection is closed, except after `reset controller` |
//! | `shutdownTimeout: SECONDS` | Webots was launched, and will be ended after this many seconds |
//! | `kind: w3d` or `kind: x3d` | the 3D scene that this Webots streams: the message with which a viewer requests it |
//! | `webots:URL` | Webots is ready there |
//! | `absence: SECONDS` | how long the simulation waits for its client once the connection is broken |
//! | `resume: TOKEN` | the token to resume the simulation with |
//! | `idle: SECONDS`, `idle: never` | when the paused simulation ends unless it runs or is kept; `never`: it no longer will |
//! | `.` | Webots is alive |
//! | `watched: 1` or `watched: 0` | an administrator watches the simulation from now on, or no longer |
//! | `realTime: 0.6` | the simulation runs at this share of real time; repeated every five seconds while it is slow, `1` once it is not any more |
//! | `reset controller: NAME/FILE` | the file was restored |
//!
//! Webots' page inserts every TEXT into `innerHTML`, so it passes through [`client_text`] and [`without_paths`] here,
//! and nowhere else.

use actix_web_actors::ws::CloseCode;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

use crate::shared::domain::{Blame, Failure, Reason, Retry, View};
use crate::shared::text::{client_text, without_paths};
use crate::simulation::attachment::Token;
use crate::simulation::progress::{Progress, Step};
use crate::simulation::snapshot::SceneKind;

/// What a message requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ClientRequest {
    /// To restore this file below `controllers/`.
    ResetController(String),
    /// To resume the simulation of this token.
    Resume(String),
    /// To start a simulation.
    Start(Start),
    /// To restart the idle timeout of a paused simulation.
    Keep,
    /// Nothing that is known.
    Nothing,
}

/// The known fields of a message, of which the first one takes effect; unknown ones are ignored.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Fields {
    #[serde(rename = "reset controller", deserialize_with = "value")]
    reset_controller: Option<String>,
    #[serde(deserialize_with = "value")]
    resume: Option<String>,
    #[serde(deserialize_with = "value")]
    start: Option<Start>,
    keep: bool,
}

/// A simulation that a client requests.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(expecting = "an object with a url")]
pub struct Start {
    /// The URL of its world.
    pub url: String,
    /// How it is shown.
    pub mode: Option<Mode>,
    /// Whether its client may resume it after its connection has broken.
    pub resumable: Option<bool>,
    /// Whether its client may also resume it while it waits or starts.
    pub early: Option<bool>,
    /// What its client calls itself.
    pub name: Option<String>,
    /// Its pass to a reserved slot, from the line of a session server.
    pub pass: Option<String>,
}

/// How a simulation is shown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// A 3D scene that the browser renders; its name until R2023b.
    #[default]
    X3d,
    /// A 3D scene that the browser renders; its name since R2025a.
    W3d,
    /// A video.
    Mjpeg,
}

impl From<Mode> for View {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::X3d | Mode::W3d => Self::X3d,
            Mode::Mjpeg => Self::Mjpeg,
        }
    }
}

/// Why a message is invalid. The message is for the client.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "Wrong message: {0}. Allowed are {{\"start\": {{\"url\": ..., \"mode\": \"x3d\", \"w3d\" or \"mjpeg\"}}}} and {{\"reset controller\": \"NAME/FILE\"}}"
)]
pub struct ClientRequestError(String);

/// Reads a field that is present. `null` is an error: if it were ignored, the client would wait for an answer.
fn value<'de, D: Deserializer<'de>, T: Deserialize<'de>>(field: D) -> Result<Option<T>, D::Error> {
    T::deserialize(field).map(Some)
}

impl ClientRequest {
    /// Parses a message of a client. JSON that is not an object requests nothing.
    ///
    /// # Errors
    /// When the message is not JSON, or its request is malformed.
    pub fn parse(text: &str) -> Result<Self, ClientRequestError> {
        let message: Value = serde_json::from_str(text).map_err(|_| ClientRequestError("it is no JSON".to_owned()))?;
        if !message.is_object() {
            return Ok(Self::Nothing);
        }
        let fields: Result<Fields, _> = serde_path_to_error::deserialize(message);
        let fields = fields.map_err(|error| ClientRequestError(error.to_string()))?;
        let reset = fields.reset_controller.map(Self::ResetController);
        let named = reset.or(fields.resume.map(Self::Resume));
        let named = named.or(fields.start.map(Self::Start));
        Ok(named.unwrap_or(if fields.keep { Self::Keep } else { Self::Nothing }))
    }
}

impl From<ClientRequestError> for Failure {
    fn from(error: ClientRequestError) -> Self {
        Self::new(Reason::InvalidRequest, error.to_string())
    }
}

/// The content of `reason:`.
#[derive(Serialize)]
struct ReasonText {
    code: Reason,
    blame: Blame,
    retry: Retry,
    /// The sentence without the output and the advice that are for pages which read no reasons.
    message: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    output: Option<String>,
}

/// The content of `progress:`.
#[derive(Serialize)]
struct ProgressText<'a> {
    step: Step,
    #[serde(skip_serializing_if = "Option::is_none")]
    percent: Option<u8>,
    text: &'a str,
}

/// The heartbeat of Webots.
pub const HEARTBEAT: &str = ".";

/// A text that a project requests: `ide: enable`, or its type, which keeps its line end as in the original.
pub fn of_project(text: &str) -> String {
    let end = if text.ends_with('\n') { "\n" } else { "" };
    client_text(text.trim_end()) + end
}

/// A text that Webots' page shows.
fn loading(text: &str) -> String {
    format!("loading: {}", client_text(&without_paths(text)))
}

/// Progress: once for programs, and once as text for Webots' page, which reads the number of a step in it.
pub fn progress(progress: &Progress) -> [String; 2] {
    let text = &client_text(&without_paths(&progress.text));
    let in_json = ProgressText {
        step: progress.step,
        percent: progress.percent,
        text,
    };
    // It has texts and numbers only: no error is possible.
    let json = serde_json::to_string(&in_json).unwrap_or_default();
    let number = progress.of_all.map(|(number, of)| format!("Step {number}/{of} : "));
    [
        format!("progress: {json}"),
        format!("loading: {}{text}", number.unwrap_or_default()),
    ]
}

/// A refusal, a failed start or an end: its reason for programs, then a sentence.
pub fn failure(failure: &Failure) -> [String; 2] {
    let Failure {
        reason,
        message,
        output,
    } = failure;
    let reason_in_json = ReasonText {
        code: *reason,
        blame: reason.blame(),
        retry: reason.retry(),
        message: client_text(&without_paths(message)),
        output: output.as_deref().map(|output| client_text(&without_paths(output))),
    };
    let mut sentence = message.clone();
    let mut add = |more: &str| sentence = format!("{}. {more}", sentence.trim_end_matches('.'));
    if let Some(output) = output {
        add(&format!("Its last output: {output}"));
    }
    if reason.retry() == Retry::Elsewhere && *reason != Reason::ServerStopped {
        add("Connect again: the session server chooses another simulation server");
    }
    if *reason != Reason::Finished {
        sentence = format!("Error: {sentence}");
    }
    // It has texts only: no error is possible.
    let json = serde_json::to_string(&reason_in_json).unwrap_or_default();
    [format!("reason: {json}"), loading(&sentence)]
}

/// The code with which a connection closes after a refusal, a failed start or an end.
pub fn close_code(reason: Reason) -> CloseCode {
    match (reason, reason.retry()) {
        (Reason::ServerStopped, _) => CloseCode::Away,
        (Reason::Lost, _) => CloseCode::Error,
        (_, Retry::Elsewhere) => CloseCode::Again,
        (_, Retry::No | Retry::Here | Retry::Later) => CloseCode::Normal,
    }
}

/// The server stops.
pub fn stopping() -> Failure {
    Failure::new(Reason::ServerStopped, "This simulation server is stopping")
}

/// The answer to `reset controller` without a running simulation.
pub fn nothing_to_reset() -> Failure {
    Failure::new(
        Reason::NothingToReset,
        "A controller can be reset only while a simulation runs",
    )
}

/// Why an administrator has stopped a simulation, as its client reads it.
pub fn stopped_by_administrator(words: &str, reason: &str) -> String {
    if reason.is_empty() {
        words.to_owned()
    } else {
        format!("{words}: {reason}")
    }
}

/// The id of a simulation.
pub fn simulation_id(id: impl std::fmt::Display) -> String {
    format!("session: {id}")
}

/// The number of clients ahead in the queue: once for programs, and once as text, because Webots' page shows only that.
pub fn queue(ahead: usize) -> [String; 2] {
    let clients = match ahead {
        0 => "you are next".to_owned(),
        1 => "1 client is ahead".to_owned(),
        more => format!("{more} clients are ahead"),
    };
    [
        format!("queue: {ahead}"),
        loading(&format!("waiting for a place, {clients}")),
    ]
}

/// The time limit of the simulation, in seconds.
pub fn shutdown_timeout(seconds: u64) -> String {
    format!("shutdownTimeout: {seconds}")
}

/// How long the simulation waits for its client once the connection is broken.
pub fn absence(seconds: u64) -> String {
    format!("absence: {seconds}")
}

/// Whether an administrator watches the simulation.
pub fn watched(is_watched: bool) -> String {
    format!("watched: {}", u8::from(is_watched))
}

/// How fast the simulation runs, if it is slower than real time; `None`: it is not any more.
pub fn real_time(slow: Option<f64>) -> String {
    // What is shown is not better than it is.
    slow.map_or("realTime: 1".to_owned(), |factor| {
        format!("realTime: {:.1}", (10.0 * factor).floor() / 10.0)
    })
}

/// The token with which the client can resume the simulation.
pub fn resume(token: &Token) -> String {
    format!("resume: {}", token.reveal())
}

/// Seconds until the simulation ends because it is paused; `None`: it no longer will.
pub fn idle(seconds: Option<u64>) -> String {
    seconds.map_or("idle: never".to_owned(), |seconds| format!("idle: {seconds}"))
}

/// Why a client can't resume a simulation that has ended for this reason; `None`: the reason is not known any more.
pub fn ended(failure: Option<&Failure>) -> Failure {
    let words = "this simulation has ended";
    match failure {
        None => Failure::new(Reason::Ended, words),
        Some(failure) => Failure {
            message: format!("{words}: {failure}"),
            ..failure.clone()
        },
    }
}

/// Why a connection is closed: another one has used its token.
pub fn taken_over() -> Failure {
    Failure::new(Reason::TakenOver, "this simulation was taken over elsewhere")
}

/// The scene that viewers request from this Webots.
pub fn kind(kind: SceneKind) -> String {
    format!("kind: {}", kind.request())
}

/// The URL of Webots, which is ready.
pub fn webots(url: &str) -> String {
    format!("webots:{url}")
}

/// Webots has sent no heartbeat for this many seconds.
pub fn hanging(seconds: u64) -> String {
    loading(&format!("Webots has given no sign of life for {seconds} seconds"))
}

/// A controller's file was restored.
pub fn reset_controller(file: &str) -> String {
    format!("reset controller: {}", client_text(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_read() {
        let start = |mode, resumable, name: Option<&str>| {
            let start = Start {
                url: "https://x".to_owned(),
                mode,
                resumable,
                early: None,
                name: name.map(str::to_owned),
                pass: None,
            };
            ClientRequest::Start(start)
        };
        let table = [
            (r#"{"start":{"url":"https://x"}}"#, start(None, None, None)),
            (
                r#"{"start":{"url":"https://x","mode":"mjpeg","more":1}}"#,
                start(Some(Mode::Mjpeg), None, None),
            ),
            (
                r#"{"start":{"url":"https://x","mode":"w3d"}}"#,
                start(Some(Mode::W3d), None, None),
            ),
            (
                r#"{"start":{"url":"https://x","resumable":true}}"#,
                start(None, Some(true), None),
            ),
            (
                r#"{"start":{"url":"https://x","name":"Anna"}}"#,
                start(None, None, Some("Anna")),
            ),
            (r#"{"resume":"any text"}"#, ClientRequest::Resume("any text".to_owned())),
            (r#"{"keep":true}"#, ClientRequest::Keep),
            (
                r#"{ "reset controller" : "a/a.py" }"#,
                ClientRequest::ResetController("a/a.py".to_owned()),
            ),
        ];
        for (text, request) in table {
            assert_eq!(ClientRequest::parse(text), Ok(request), "{text}");
        }
        for text in [
            "{}",
            "[1]",
            "5",
            "null",
            r#"{"init":["host","project"]}"#,
            r#""start""#,
            r#"{"keep":false}"#,
        ] {
            assert_eq!(ClientRequest::parse(text), Ok(ClientRequest::Nothing), "{text}");
        }
    }

    #[test]
    fn anything_else_is_refused_in_words() {
        let table = [
            ("", "it is no JSON"),
            ("garbage", "it is no JSON"),
            (r#"{"start":{}}"#, "start: missing field `url`"),
            (r#"{"start":5}"#, "start: invalid type: integer `5`"),
            (
                r#"{"start":{"url":"x","mode":"vr"}}"#,
                "start.mode: unknown variant `vr`, expected one of `x3d`, `w3d`, `mjpeg`",
            ),
            (
                r#"{"start":{"url":5}}"#,
                "start.url: invalid type: integer `5`, expected a string",
            ),
            (
                r#"{"start":{"url":"x","resumable":1}}"#,
                "start.resumable: invalid type: integer `1`, expected a boolean",
            ),
            (
                r#"{"start":{"url":"x","name":{}}}"#,
                "start.name: invalid type: map, expected a string",
            ),
            (r#"{"resume":null}"#, "resume: invalid type: null, expected a string"),
            (
                r#"{"start":"URL"}"#,
                "start: invalid type: string \"URL\", expected an object with a url",
            ),
            (
                r#"{"resume":5}"#,
                "resume: invalid type: integer `5`, expected a string",
            ),
            (r#"{"keep":5}"#, "keep: invalid type: integer `5`, expected a boolean"),
            (
                r#"{"reset controller":5}"#,
                "reset controller: invalid type: integer `5`, expected a string",
            ),
        ];
        for (text, words) in table {
            let error = ClientRequest::parse(text).unwrap_err().to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
    }
}
