//! Actor: probes one simulation server.
//!
//! Created by the registry for each simulation server, in the thread of all monitors. Every `loadRefresh` it requests the
//! server's state, one request at a time, and sends the result to its parent. If the parent's mailbox is full, the result
//! is dropped: the next probe replaces it. It ends when it receives [`Stop`]; after a panic its parent starts a new one.
//!
//! In a fleet with a key it also keeps the link over which the server reserves slots for the line (`slot_link`).
//!
//! It requests `/status`, or `/load` if the server has no `/status`, as the original. No answer is trusted: the whole
//! probe has a timeout, the answer a size limit, and the load must be plausible.

use std::cell::Cell;
use std::fmt::Display;
use std::rc::Rc;
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use actix::prelude::*;
use actix_tls::connect::{Connector as TcpConnector, Resolver};
use actix_web::web::Bytes;
use awc::error::{ConnectError, PayloadError, SendRequestError};
use awc::http::StatusCode;
use awc::http::header::CONTENT_LENGTH;
use futures_util::Stream;
use rustls::ClientConfig;
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};
use tokio::sync::watch;
use tokio::time::{sleep_until, timeout};

use super::resolver::HostResolver;
use super::slot_link::{LinkEvent, SlotLink};
use crate::session::class::Roster;
use crate::session::config::SessionConfig;
use crate::shared::domain::{Failure, FleetKey, Load, PublicAddress, Reason, ServerReport, ToSimulationServer};
use crate::shared::http::tls;
use crate::shared::text::excerpt;

/// The result of a probe.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub struct ProbeResult {
    /// The server.
    pub server: PublicAddress,
    /// Duration of the probe.
    pub latency: Duration,
    /// The server's report, or why the probe failed.
    pub answer: Result<ServerReport, Failure>,
}

/// Size limit of the records of a server, in bytes.
const MAX_RECORDS: usize = 64 * 1024 * 1024;
/// Timeout of these.
const RECORDS: Duration = Duration::from_secs(30);
/// Size limit of an answer, in bytes.
const MAX_ANSWER_SIZE: usize = 1024 * 1024;
/// The highest plausible load, in percent.
const MAX_LOAD: f64 = 1000.0;
/// Longer than any probe may take: awc has timeouts of its own, which can't all be turned off.
const NEVER: Duration = Duration::from_hours(24);
/// Probes of all monitors start at multiples of this time, so that the thread wakes once for many of them.
const SLOT: Duration = Duration::from_millis(10);
/// The start of the first of these slots.
static BEGIN: LazyLock<Instant> = LazyLock::new(Instant::now);
/// Longest text of a server that is kept, in characters.
const MAX_TEXT_LENGTH: usize = 500;
/// Status codes of a server that has no such page; some servers answer only that the request is invalid.
const NO_SUCH_PAGE: [StatusCode; 4] = [
    StatusCode::NOT_FOUND,
    StatusCode::BAD_REQUEST,
    StatusCode::METHOD_NOT_ALLOWED,
    StatusCode::NOT_IMPLEMENTED,
];
/// Time for which only `/load` is requested from a server without `/status`.
const LOAD_ONLY: Duration = Duration::from_mins(1);

/// An HTTP client that keeps one connection to the simulation server.
fn client(interval: Duration, tls: Option<Arc<ClientConfig>>) -> awc::Client {
    let idle = (interval * 3).max(Duration::from_secs(15));
    // The whole probe has a timeout, its parts have none.
    let tcp = TcpConnector::new(Resolver::custom(HostResolver)).service();
    let connector = awc::Connector::new().connector(tcp).conn_keep_alive(idle);
    let mut connector = connector.conn_lifetime(NEVER).timeout(NEVER);
    if let Some(config) = tls {
        connector = connector.rustls_0_23(config);
    }
    awc::Client::builder()
        .connector(connector)
        .disable_timeout()
        .disable_redirects()
        .finish()
}

/// Sends the server a message over its link.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Ask(pub ToSimulationServer);

/// The parent of a monitor, which receives what it finds.
#[derive(Clone)]
pub struct Parent {
    /// Receives the results of probes.
    pub probes: Recipient<ProbeResult>,
    /// Receives what happens to the link.
    pub links: Recipient<LinkEvent>,
    /// Learns which simulations the server has.
    pub roster: Arc<Roster>,
}

/// Requests the records of ended simulations of a span of time.
#[derive(Message, Clone)]
#[rtype(result = "Result<Bytes, Failure>")]
pub struct GetRecords {
    /// The query of the request.
    pub query: String,
    /// Lets an administrator in.
    pub token: String,
}

/// Ends the monitor.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Stop;

/// The actor.
pub struct ServerMonitor {
    server: PublicAddress,
    target: Rc<Target>,
    /// When the probe after the immediate one is due; the others follow every `interval`.
    first: Instant,
    interval: Duration,
    parent: Parent,
    /// The link before it is opened.
    link: Option<SlotLink>,
    /// Whether the server says that it reserves slots.
    reserves: watch::Sender<bool>,
    /// Sends messages over the link.
    messages: Option<UnboundedSender<ToSimulationServer>>,
}

/// What a probe needs.
struct Target {
    client: awc::Client,
    url: String,
    /// Time limit of a probe.
    limit: Duration,
    /// When the server was last found to have no `/status`.
    without_status: Cell<Option<Instant>>,
}

impl ServerMonitor {
    /// The monitor of a server. It must be created in the thread in which it runs.
    pub fn new(server: PublicAddress, config: &SessionConfig, tls: Option<Arc<ClientConfig>>, parent: Parent) -> Self {
        let interval = config.load_refresh;
        // The slot is random: reports of all servers in the same slot would delay the requests of clients.
        let slot = (BEGIN.elapsed() + interval.mul_f64(rand::random()))
            .div_duration_f64(SLOT)
            .ceil();
        let client = client(interval, tls);
        let link = config.fleet_key.as_ref().map(|key| SlotLink {
            server: server.clone(),
            url: format!("{}/slots", server.websocket_url(config.ssl)),
            client: client.clone(),
            key: FleetKey::new(key.reveal()),
            events: parent.links.clone(),
            roster: Arc::clone(&parent.roster),
            page: format!("{}/class", config.http_url()),
        });
        Self {
            link,
            reserves: watch::Sender::new(false),
            messages: None,
            target: Rc::new(Target {
                client,
                url: server.http_url(config.ssl),
                limit: config.timing.answer,
                without_status: Cell::new(None),
            }),
            server,
            first: *BEGIN + SLOT.mul_f64(slot),
            interval,
            parent,
        }
    }

    /// Probes the server at this time, sends the result, and continues with the next probe.
    fn probe_at(&self, due: Instant, ctx: &mut Context<Self>) {
        let target = Rc::clone(&self.target);
        let probe = async move {
            sleep_until(due.into()).await;
            let begun = Instant::now();
            let answer = timeout(target.limit, target.probe()).await;
            let limit = target.limit.as_secs_f64();
            let late = |_| Err(Failure::new(Reason::NoAnswer, format!("no answer within {limit} s")));
            (answer.unwrap_or_else(late), begun.elapsed())
        };
        let finish = |(answer, latency), monitor: &mut Self, ctx: &mut Context<Self>| {
            monitor.send(answer, latency, ctx);
            monitor.probe_at(monitor.next(Instant::now()), ctx);
        };
        probe.into_actor(self).map(finish).spawn(ctx);
    }

    /// When the next probe is due. Times that passed during a probe are skipped.
    fn next(&self, now: Instant) -> Instant {
        let Some(passed) = now.checked_duration_since(self.first) else {
            return self.first;
        };
        self.first
            + self
                .interval
                .mul_f64(passed.div_duration_f64(self.interval).floor() + 1.0)
    }

    fn send(&self, answer: Result<ServerReport, Failure>, latency: Duration, ctx: &mut Context<Self>) {
        let reserves = answer.as_ref().is_ok_and(|report| report.reserves);
        self.reserves
            .send_if_modified(|before| std::mem::replace(before, reserves) != reserves);
        let result = ProbeResult {
            server: self.server.clone(),
            latency,
            answer,
        };
        match self.parent.probes.try_send(result) {
            Ok(()) => {}
            Err(SendError::Full(_)) => log::warn!("{}: a report is lost, too many are waiting", self.server),
            // The registry has stopped, and the server with it.
            Err(SendError::Closed(_)) => ctx.stop(),
        }
    }
}

impl Actor for ServerMonitor {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        self.probe_at(Instant::now(), ctx);
        if let Some(link) = self.link.take() {
            let (sender, messages) = unbounded_channel();
            self.messages = Some(sender);
            link.keep(messages, self.reserves.subscribe())
                .into_actor(self)
                .spawn(ctx);
        }
    }
}

impl Handler<Ask> for ServerMonitor {
    type Result = ();

    fn handle(&mut self, Ask(message): Ask, _: &mut Self::Context) {
        if let Some(sender) = &self.messages {
            // The link ends with this monitor.
            sender.send(message).ok();
        }
    }
}

impl Handler<GetRecords> for ServerMonitor {
    type Result = ResponseFuture<Result<Bytes, Failure>>;

    fn handle(&mut self, GetRecords { query, token }: GetRecords, _: &mut Self::Context) -> Self::Result {
        let target = Rc::clone(&self.target);
        Box::pin(async move {
            let url = format!("{}/simulations.csv?{query}", target.url);
            let fetching = async {
                let request = target.client.get(url).bearer_auth(token);
                let answer = request.send().await.map_err(no_answer)?;
                if !answer.status().is_success() {
                    return Err(bad_answer(format!("status {}", answer.status())));
                }
                whole_body(answer, MAX_RECORDS).await
            };
            let late = |_| Err(Failure::new(Reason::NoAnswer, "it did not send its records in time"));
            timeout(RECORDS, fetching).await.unwrap_or_else(late)
        })
    }
}

impl Handler<Stop> for ServerMonitor {
    type Result = ();

    fn handle(&mut self, _: Stop, ctx: &mut Self::Context) {
        ctx.stop();
    }
}

impl Target {
    /// Requests the report of the server.
    async fn probe(&self) -> Result<ServerReport, Failure> {
        let may_have_status = self
            .without_status
            .get()
            .is_none_or(|found| found.elapsed() >= LOAD_ONLY);
        if may_have_status && let Some(body) = get(&self.client, &format!("{}/status", self.url)).await? {
            return usable(ServerReport::parse(&body).map_err(bad_answer)?);
        }
        let body = get(&self.client, &format!("{}/load", self.url)).await?;
        let body = body.ok_or_else(|| bad_answer("it has neither /status nor /load"))?;
        let report = usable(ServerReport::load_only(Load::parse(&body).map_err(bad_answer)?))?;
        if may_have_status {
            self.without_status.set(Some(Instant::now()));
        }
        Ok(report)
    }
}

/// Returns the body of a page, `None` if the server has no such page.
///
/// # Errors
/// When no valid answer arrives, or one that is cut off.
async fn get(client: &awc::Client, url: &str) -> Result<Option<Bytes>, Failure> {
    let answer = match client.get(url).send().await {
        // The server may have closed an idle connection, which is not a failure: retry once.
        Err(error) if is_broken(&error) => client.get(url).send().await,
        answer => answer,
    }
    .map_err(no_answer)?;
    let status = answer.status();
    if NO_SUCH_PAGE.contains(&status) {
        return Ok(None);
    }
    if !status.is_success() {
        return Err(bad_answer(format!("status {status}")));
    }
    whole_body(answer, MAX_ANSWER_SIZE).await.map(Some)
}

/// The body of an answer, which has this many bytes at most.
///
/// # Errors
/// When it is longer, or cut off: awc takes the end of the connection for the end of the body, so that 95.5 may arrive as 9.
async fn whole_body<S>(answer: awc::ClientResponse<S>, limit: usize) -> Result<Bytes, Failure>
where
    S: Stream<Item = Result<Bytes, PayloadError>> + Unpin,
{
    let length = answer
        .headers()
        .get(CONTENT_LENGTH)
        .and_then(|value| value.to_str().ok()?.parse::<usize>().ok());
    let body = answer.timeout(NEVER).body().limit(limit).await.map_err(bad_answer)?;
    if length != Some(body.len()) {
        return Err(bad_answer("it does not end as its Content-Length says"));
    }
    Ok(body)
}

/// Whether an established connection broke.
fn is_broken(error: &SendRequestError) -> bool {
    !matches!(error, SendRequestError::Connect(reason) if !matches!(reason, ConnectError::Disconnected))
}

fn no_answer(error: SendRequestError) -> Failure {
    let cause = match error {
        SendRequestError::Connect(ConnectError::Disconnected) => "it was closed without an answer".to_owned(),
        error => tls::reason(&error).unwrap_or_else(|| excerpt(&error.to_string(), MAX_TEXT_LENGTH)),
    };
    Failure::new(Reason::NoAnswer, format!("no connection: {cause}"))
}

/// Refuses the report of a server that can't start simulations, or whose load is not plausible.
fn usable(report: ServerReport) -> Result<ServerReport, Failure> {
    if report.load.percent() > MAX_LOAD {
        return Err(bad_answer(format!("a load of {} %", report.load)));
    }
    match &report.problem {
        Some(problem) => {
            let failure = Failure::new(Reason::NotReady, "it can start no simulation");
            Err(failure.with_output(excerpt(problem, MAX_TEXT_LENGTH)))
        }
        None => Ok(report),
    }
}

fn bad_answer(cause: impl Display) -> Failure {
    let cause = excerpt(&cause.to_string(), MAX_TEXT_LENGTH);
    Failure::new(Reason::InvalidAnswer, format!("an answer that makes no sense: {cause}"))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::sample::select;

    use super::*;

    /// Any text, or one with which a server or another program tells a reason.
    fn texts() -> impl Strategy<Value = String> {
        const KNOWN: [&str; 5] = [
            "no answer within 3 s",
            "no connection: it was closed without an answer",
            "No space left on device (os error 28)",
            "Cannot connect to the Docker daemon at unix:///var/run/docker.sock",
            "no simulation server available at the moment",
        ];
        let codes = Reason::ALL.iter().map(|reason| reason.code());
        let known: Vec<&str> = KNOWN.into_iter().chain(codes).collect();
        prop_oneof![any::<String>(), select(known).prop_map(str::to_owned)]
    }

    proptest! {
        #[test]
        fn what_a_server_writes_decides_nothing(text in texts()) {
            let healthy = ServerReport { version: text.clone(), ..ServerReport::load_only(Load::ZERO) };
            prop_assert!(usable(healthy.clone()).is_ok());
            let failure = usable(ServerReport { problem: Some(text.clone()), ..healthy }).unwrap_err();
            prop_assert_eq!((failure.reason, failure.message.as_str()), (Reason::NotReady, "it can start no simulation"));
            prop_assert_eq!(bad_answer(text).reason, Reason::InvalidAnswer);
        }
    }
}
