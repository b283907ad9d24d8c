//! The acceptance run: one client goes through all steps, and each is compared with the expected behaviour of a fleet
//! and of Webots (`docs/protocol.md`). The output is Markdown that can be pasted into an issue.

use std::time::{Duration, Instant};

use crate::arguments::Arguments;
use crate::connection::{Connection, Deadline, Ended, unless_error};
use crate::session_server::SessionServer;
use crate::step_log::StepLog;
use crate::words::{add, excerpt, over, told};

/// Timeout of an answer; other texts may arrive before it.
const ANSWER: Duration = Duration::from_secs(20);
/// Timeout of the scene.
const SCENE: Duration = Duration::from_mins(1);
/// Timeout of the next heartbeat, which is due after 5 s; busy machines are late.
const HEARTBEAT: Duration = Duration::from_secs(10);
/// Time in which buffered heartbeats are discarded.
const BUFFERED: Duration = Duration::from_millis(100);
/// Time for which updates are measured, from the first one on.
const WATCH: Duration = Duration::from_secs(3);
/// Timeout of Webots' end once its client has left.
const GONE: Duration = Duration::from_secs(15);
/// Prefixes of the texts that Webots' page knows or ignores on the connection to the simulation server.
const KNOWN: [&str; 13] = [
    "session:",
    "reason:",
    "progress:",
    "loading:",
    "queue:",
    "shutdownTimeout:",
    "kind: ",
    "webots:",
    "ide: ",
    "type:",
    "error:",
    "reset controller:",
    ".",
];

/// The walk can't continue.
struct StepError;

/// Walks through all steps and prints the results. Returns whether all of them were as expected.
///
/// # Errors
/// When the session server does not answer at all.
pub(crate) async fn run(arguments: &Arguments) -> Result<bool, String> {
    let session_server = SessionServer::new(&arguments.fleet);
    session_server.answers().await?;
    let mut walk = StepLog::begin(arguments);
    // The last printed step shows where it failed.
    Box::pin(walk.go(arguments, &session_server)).await.ok();
    Ok(walk.end())
}

/// The texts on the connection to the simulation server until Webots was ready, or its start failed.
struct Start {
    texts: u32,
    unknown: Vec<String>,
    limit: Option<String>,
    /// `webots:...`, or why it was not received.
    end: String,
}

impl StepLog {
    async fn go(&mut self, arguments: &Arguments, session_server: &SessionServer) -> Result<(), StepError> {
        self.ask_for_availability(arguments, session_server).await?;
        let (mut lease, webots) = self.start(arguments, session_server).await?;
        let address = format!("{}/", webots.trim_end_matches('/'));
        let opened = Connection::open_scene(&address).await;
        let came = opened
            .as_ref()
            .map_or_else(ToString::to_string, |_| "a WebSocket".to_owned());
        self.note("stream", "Webots takes a WebSocket at `/`", &came, opened.is_ok());
        let mut stream = opened.map_err(|_| StepError)?;
        self.see_the_scene(arguments, &mut stream).await?;
        self.command(
            arguments,
            &mut stream,
            "pause",
            "pause",
            "`paused by client`",
            "paused by client",
        )
        .await?;
        self.run(arguments, &mut stream).await?;
        self.hear_heartbeats(arguments, &mut lease).await?;
        self.command(
            arguments,
            &mut stream,
            "pause again",
            "pause",
            "`paused by client`",
            "paused by client",
        )
        .await?;
        self.command(
            arguments,
            &mut stream,
            "step",
            "step",
            "an update, then `paused by client`",
            "paused by client",
        )
        .await?;
        self.command(
            arguments,
            &mut stream,
            "reset",
            "reset",
            "`reset finished`",
            "reset finished",
        )
        .await?;
        stream.close().await;
        lease.close().await;
        self.see_it_gone(&address).await;
        Ok(())
    }

    async fn ask_for_availability(
        &mut self,
        arguments: &Arguments,
        session_server: &SessionServer,
    ) -> Result<(), StepError> {
        let expected = "`1` or `0` as the first text of the WebSocket `/`";
        let first = match Connection::open(&session_server.availability_url()).await {
            Ok(mut availability) => availability.receive_by(limit(ANSWER, arguments)).await,
            Err(ended) => Err(ended),
        };
        let agrees = matches!(first.as_deref(), Ok("0" | "1"));
        self.note("availability", expected, &told(&first), agrees);
        first.map_err(|_| StepError)?;
        let available = actix_rt::time::timeout(arguments.patience, session_server.until_available()).await;
        let came = match &available {
            Ok(Ok(())) => "`1`".to_owned(),
            Ok(Err(ended)) => over(ended),
            Err(_) => "`0` all the time".to_owned(),
        };
        let agrees = matches!(available, Ok(Ok(())));
        self.note(
            "a free server",
            "`1` before the patience ends: some server can take a client",
            &came,
            agrees,
        );
        if agrees { Ok(()) } else { Err(StepError) }
    }

    /// Requests a simulation server and starts the world there. Returns the connection and the URL of Webots.
    async fn start(
        &mut self,
        arguments: &Arguments,
        session_server: &SessionServer,
    ) -> Result<(Connection, String), StepError> {
        let server = session_server.simulation_server(&arguments.world).await;
        let came = excerpt(match &server {
            Ok(url) => url,
            Err(none) => &none.answer,
        });
        self.note(
            "simulation server",
            "`ws://HOST:PORT` or `wss://HOST/PORT`",
            &came,
            server.is_ok(),
        );
        let server = server.map_err(|_| StepError)?;
        let opened = Connection::open(&format!("{server}/client")).await;
        let came = opened
            .as_ref()
            .map_or_else(ToString::to_string, |_| "a WebSocket".to_owned());
        self.note("client", "a WebSocket at `/client`", &came, opened.is_ok());
        let mut lease = opened.map_err(|_| StepError)?;
        let Start {
            texts,
            unknown,
            limit,
            end,
        } = follow(&mut lease, arguments).await;
        let came = if unknown.is_empty() {
            format!("{texts} texts, all known")
        } else {
            unknown.join(" ")
        };
        self.note(
            "progress",
            "only texts that Webots' page knows",
            &came,
            unknown.is_empty(),
        );
        let is_limit = limit.as_ref().is_some_and(|limit| limit.parse::<u64>().is_ok());
        let came = limit.unwrap_or_else(|| "none".to_owned());
        self.note(
            "time limit",
            "`shutdownTimeout: SECONDS` before Webots is ready",
            &came,
            is_limit,
        );
        let url = end
            .strip_prefix("webots:")
            .filter(|url| url.starts_with("ws") && !url.ends_with('/'));
        self.note(
            "Webots is ready",
            "`webots:ws...`, without a slash at the end",
            &excerpt(&end),
            url.is_some(),
        );
        url.map(|url| (lease, url.to_owned())).ok_or(StepError)
    }

    async fn see_the_scene(&mut self, arguments: &Arguments, stream: &mut Connection) -> Result<(), StepError> {
        let expected = "`world:`, `model:`, `application/json:`, `scene load completed`, the state, in this order";
        let mut order = Vec::new();
        let mut model = String::new();
        let deadline = limit(SCENE, arguments);
        let mut ended = stream.say(&arguments.viewer).await.err();
        let is_state = |text: &str| text.starts_with("pause:") || text == "real-time" || text == "fast";
        while ended.is_none() {
            match stream.receive_by(deadline).await.and_then(unless_error) {
                Ok(text) => {
                    let begin = text.split_inclusive(':').next().unwrap_or_default();
                    let begin = if begin.starts_with("model:") { "model:" } else { begin };
                    if !matches!(begin, "loading:" | "robot window:" | "stdout:" | "stderr:") {
                        add(&mut order, begin);
                    }
                    if let Some(xml) = text.strip_prefix("model:") {
                        xml.clone_into(&mut model);
                    }
                    if is_state(&text) {
                        break;
                    }
                }
                Err(error) => ended = Some(error),
            }
        }
        let known = ["`world:`", "`model:`", "`application/json:`", "`scene load completed`"];
        let agrees =
            ended.is_none() && order.iter().take(known.len()).eq(known.iter()) && order.len() == known.len() + 1;
        let failed = ended
            .as_ref()
            .map(|ended| format!(", then {}", over(ended)))
            .unwrap_or_default();
        self.note("scene", expected, &format!("{}{failed}", order.join(", ")), agrees);
        let is_model = model.contains("<Scene") && model.contains("<Viewpoint");
        let came = format!("{} bytes: {}", model.len(), excerpt(&model));
        self.note("model", "XML with a `Scene` and a `Viewpoint`", &came, is_model);
        ended.map_or(Ok(()), |_| Err(StepError))
    }

    /// Sends a command and waits for its answer; updates may arrive before.
    async fn command(
        &mut self,
        arguments: &Arguments,
        stream: &mut Connection,
        name: &'static str,
        command: &str,
        expected: &'static str,
        answer: &str,
    ) -> Result<(), StepError> {
        let deadline = limit(ANSWER, arguments);
        let mut came = stream.say(command).await.map(|()| String::new());
        let mut others = Vec::new();
        let mut updates = 0;
        while came.as_ref().is_ok_and(|text| text != answer) {
            came = stream.receive_by(deadline).await.and_then(unless_error);
            match &came {
                Ok(text) if text.starts_with("application/json:") => updates += 1,
                Ok(text) if text == answer => {}
                Ok(text)
                    if ["visibility:", "stdout:", "stderr:"]
                        .iter()
                        .any(|one| text.starts_with(one)) => {}
                Ok(text) => add(&mut others, text),
                Err(_) => {}
            }
        }
        let before = if others.is_empty() {
            String::new()
        } else {
            format!("{}, then ", others.join(", "))
        };
        let before = if updates == 0 {
            before
        } else {
            format!("{updates} updates, {before}")
        };
        let agrees = came.is_ok() && others.is_empty() && (command != "step" || updates == 1);
        self.note(name, expected, &format!("{before}{}", told(&came)), agrees);
        came.map(drop).map_err(|_| StepError)
    }

    async fn run(&mut self, arguments: &Arguments, stream: &mut Connection) -> Result<(), StepError> {
        self.command(arguments, stream, "run", "real-time:-1", "`real-time`", "real-time")
            .await?;
        let mut updates: Vec<(Instant, f64)> = Vec::new();
        let mut deadline = limit(ANSWER, arguments);
        while let Ok(text) = stream.receive_by(deadline).await {
            let json = text.strip_prefix("application/json:");
            let json = json.and_then(|json| serde_json::from_str::<serde_json::Value>(json).ok());
            if let Some(time) = json.and_then(|json| json.get("time")?.as_f64()) {
                if updates.is_empty() {
                    deadline = Deadline::within(WATCH);
                }
                updates.push((Instant::now(), time));
            }
        }
        let grows = updates.is_sorted_by_key(|(_, time)| *time);
        let (per_second, factor) = rates(&updates).unwrap_or_default();
        let came = format!("{per_second:.0} in a second");
        let agrees = grows && factor > 0.0 && per_second < 90.0;
        self.note(
            "updates",
            "with growing `time`, at most some 60 in a second",
            &came,
            agrees,
        );
        let came = format!("{factor:.2} of real time");
        self.note("pace", "0.9 of real time or more", &came, (0.9..1.2).contains(&factor));
        if updates.is_empty() { Err(StepError) } else { Ok(()) }
    }

    async fn hear_heartbeats(&mut self, arguments: &Arguments, lease: &mut Connection) -> Result<(), StepError> {
        // The arrival time of buffered texts is unknown.
        let buffered = Deadline::within(BUFFERED);
        while lease.receive_by(buffered).await.is_ok() {}
        let began = Instant::now();
        let deadline = limit(HEARTBEAT, arguments);
        let mut last = lease.receive_by(deadline).await;
        while last.as_ref().is_ok_and(|text| text != ".") {
            last = lease.receive_by(deadline).await;
        }
        let came = match &last {
            Ok(_) => format!("one after {:.1} s", began.elapsed().as_secs_f64()),
            Err(ended) => over(ended),
        };
        self.note("signs of life", "`.` on `/client` every 5 s", &came, last.is_ok());
        if matches!(last, Ok(_) | Err(Ended::Late(_))) {
            Ok(())
        } else {
            Err(StepError)
        }
    }

    async fn see_it_gone(&mut self, address: &str) {
        let deadline = Instant::now() + GONE;
        let mut is_gone = false;
        while !is_gone && Instant::now() < deadline {
            // A Webots that does not accept a connection in time may still run.
            let opened = tokio::time::timeout_at(deadline.into(), Connection::open(address)).await;
            is_gone = opened.is_ok_and(|opened| opened.is_err());
            actix_rt::time::sleep(Duration::from_millis(100)).await;
        }
        let came = if is_gone {
            "nobody there"
        } else {
            "Webots still answers"
        };
        self.note("leave", "Webots has ended once its client has left", came, is_gone);
    }
}

/// Starts the world, and reads texts until Webots is ready, or its start fails.
async fn follow(lease: &mut Connection, arguments: &Arguments) -> Start {
    let deadline = Deadline::within(arguments.patience);
    let mut start = Start {
        texts: 0,
        unknown: Vec::new(),
        limit: None,
        end: String::new(),
    };
    let wish = serde_json::json!({"start": {"url": arguments.world}}).to_string();
    let mut heard = lease.say(&wish).await.map(|()| String::new());
    loop {
        if heard.is_ok() {
            heard = lease.receive_by(deadline).await;
        }
        let text = match heard.as_ref() {
            Ok(text) => text,
            Err(ended) => {
                start.end = over(ended);
                return start;
            }
        };
        start.texts += 1;
        if !KNOWN.iter().any(|known| text.starts_with(known)) {
            add(&mut start.unknown, text);
        }
        if let Some(limit) = text.strip_prefix("shutdownTimeout:") {
            start.limit = Some(limit.trim().to_owned());
        }
        if ["webots:", "error:", "loading: Error:"]
            .iter()
            .any(|end| text.starts_with(end))
        {
            text.clone_into(&mut start.end);
            return start;
        }
    }
}

/// The deadline of a step that begins now, limited by `--patience`.
fn limit(step: Duration, arguments: &Arguments) -> Deadline {
    Deadline::within(step.min(arguments.patience))
}

/// Updates in a second and the share of real time, from the first update to the last one.
fn rates(updates: &[(Instant, f64)]) -> Option<(f64, f64)> {
    let ((began, first), (ended, last)) = updates.first().zip(updates.last())?;
    let wall = (*ended - *began).as_secs_f64();
    let count = f64::from(u32::try_from(updates.len() - 1).unwrap_or(u32::MAX));
    (wall > 0.0).then(|| (count / wall, (last - first) / 1000.0 / wall))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn updates_are_measured_from_the_first_one() {
        let began = Instant::now();
        let late = (400_u32..=3000)
            .step_by(40)
            .map(|ms| (began + Duration::from_millis(ms.into()), f64::from(ms - 400)));
        let (per_second, factor) = rates(&late.collect::<Vec<_>>()).unwrap();
        assert!(
            (per_second - 25.0).abs() < 0.1 && (factor - 1.0).abs() < 0.01,
            "{per_second} {factor}"
        );
        assert_eq!((rates(&[]), rates(&[(began, 1.0)])), (None, None));
    }
}
