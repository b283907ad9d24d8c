//! Actor: watches one simulation server.
//!
//! Created by the registry for each address in `simulationServers`. Every [`Watch::refresh`] it asks the server for its
//! state, with one request in flight at most, and tells the registry what came: it judges nothing itself. A report for which
//! the registry has no room is lost: the next look makes another. It ends when the registry says so; after a panic the
//! registry makes a new one.
//!
//! It asks for `/status`; a server that has no such page is asked for `/load`, as the original is. Nothing that comes is
//! trusted: the whole exchange has one time limit, an answer has a largest size, and a load must be one.

use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use actix::prelude::*;
use actix_tls::connect::{Connector as TcpConnector, Resolver};
use awc::error::{ConnectError, SendRequestError};
use awc::http::StatusCode;
use rustls::ClientConfig;

use super::probe_error::Unreachable;
use super::resolver::Names;
use crate::shared::domain::Load;
use crate::shared::domain::PublicAddress;
use crate::shared::domain::ServerReport;
use crate::shared::domain::one_line;
use crate::shared::http::tls;

/// What was learned about a simulation server.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub struct Reported {
    /// The server.
    pub server: PublicAddress,
    /// How long it took to answer, or until that was given up.
    pub latency: Duration,
    /// What it said of itself, or why it can't be counted on.
    pub answer: Result<ServerReport, Unreachable>,
}

/// How often and how patiently a server is asked. As a message it changes a monitor's ways.
#[derive(Message, Debug, Clone, Copy, PartialEq)]
#[rtype(result = "()")]
pub struct Watch {
    /// Between two looks.
    pub refresh: Duration,
    /// How long an answer may take.
    pub patience: Duration,
    /// Whether the fleet is behind https.
    pub ssl: bool,
}

/// Asks a monitor to end: its server is no longer one of the fleet.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Forget;

/// The actor.
pub struct ServerMonitor {
    server: PublicAddress,
    watch: Watch,
    client: awc::Client,
    reports: Recipient<Reported>,
    asking: bool,
    /// The next look, or all that follow.
    looks: SpawnHandle,
    /// Until when a server that has no `/status` is asked for `/load` alone.
    load_only_until: Option<Instant>,
}

/// The largest answer that is read, in bytes.
const LARGEST_ANSWER: usize = 1024 * 1024;
/// A load beyond this is none, in percent.
const LARGEST_LOAD: f64 = 1000.0;
/// Longer than any time limit of a look.
const NEVER: Duration = Duration::from_hours(24);
/// Monitors are woken together that are to look within so much time.
const MOMENT: Duration = Duration::from_millis(10);
/// From when moments are counted.
static BEGIN: LazyLock<Instant> = LazyLock::new(Instant::now);
/// For how long a server is taken to have no `/status`.
const LOAD_ONLY: Duration = Duration::from_mins(1);

/// What a server says that has no such page: some know no better than that the request is wrong.
const NO_SUCH_PAGE: [StatusCode; 4] =
    [StatusCode::NOT_FOUND, StatusCode::BAD_REQUEST, StatusCode::METHOD_NOT_ALLOWED, StatusCode::NOT_IMPLEMENTED];

/// What was understood of an answer.
enum Answer {
    Status(ServerReport),
    /// There is no `/status`, but a `/load`.
    Load(Load),
}

/// What a monitor asks with: it keeps one connection to its simulation server.
fn client(refresh: Duration, trust: Option<Arc<ClientConfig>>) -> awc::Client {
    let idle = (refresh * 3).max(Duration::from_secs(15));
    // A look as a whole has a time limit, its parts have none.
    let names = Resolver::custom(Names::default());
    let tcp = TcpConnector::new(names).service();
    let mut connector = awc::Connector::new().connector(tcp).conn_keep_alive(idle).timeout(NEVER);
    if let Some(config) = trust {
        connector = connector.rustls_0_23(config);
    }
    awc::Client::builder().connector(connector).disable_timeout().disable_redirects().finish()
}

impl ServerMonitor {
    /// A monitor of one server, which trusts these authorities. To be made in the thread in which it is to live.
    #[must_use]
    pub fn new(
        server: PublicAddress,
        watch: Watch,
        trust: Option<Arc<ClientConfig>>,
        reports: Recipient<Reported>,
    ) -> Self {
        let looks = SpawnHandle::default();
        let client = client(watch.refresh, trust);
        Self { server, watch, client, reports, asking: false, looks, load_only_until: None }
    }

    /// Asks now, and then at regular times that are those of few other monitors: were the whole fleet asked in the same
    /// moment, the door would wait meanwhile; were each asked in a moment of its own, the thread would be woken for each.
    fn begin(&mut self, ctx: &mut Context<Self>) {
        ctx.cancel_future(self.looks);
        self.ask(ctx);
        let since = BEGIN.elapsed();
        let first = (since + self.watch.refresh.mul_f64(rand::random())).div_duration_f64(MOMENT).ceil();
        let first = MOMENT.mul_f64(first).saturating_sub(since);
        self.looks = ctx.run_later(first, |monitor, ctx| {
            monitor.ask(ctx);
            monitor.looks = ctx.run_interval(monitor.watch.refresh, Self::ask);
        });
    }

    fn ask(&mut self, ctx: &mut Context<Self>) {
        if std::mem::replace(&mut self.asking, true) {
            return;
        }
        let (client, url, patience) = (self.client.clone(), self.server.http_url(self.watch.ssl), self.watch.patience);
        let load_only = self.load_only_until.is_some_and(|end| Instant::now() < end);
        let begun = Instant::now();
        let exchange = async move {
            let answer = actix_rt::time::timeout(patience, exchange(&client, &url, load_only)).await;
            (answer.unwrap_or(Err(Unreachable::TimedOut(patience))), begun.elapsed())
        };
        exchange
            .into_actor(self)
            .map(|(answer, latency), monitor, ctx| {
                monitor.asking = false;
                let answer = answer.map(|answer| monitor.understood(answer));
                match monitor.reports.try_send(Reported { server: monitor.server.clone(), latency, answer }) {
                    Ok(()) => {}
                    Err(SendError::Full(_)) => log::warn!("{}: a report is lost, too many are waiting", monitor.server),
                    // Without a registry there is nothing to do.
                    Err(SendError::Closed(_)) => ctx.stop(),
                }
            })
            .spawn(ctx);
    }

    fn understood(&mut self, answer: Answer) -> ServerReport {
        match answer {
            Answer::Status(report) => report,
            Answer::Load(load) => {
                if self.load_only_until.is_none_or(|end| Instant::now() >= end) {
                    self.load_only_until = Some(Instant::now() + LOAD_ONLY);
                }
                ServerReport::load_only(load)
            }
        }
    }
}

impl Actor for ServerMonitor {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        self.begin(ctx);
    }
}

impl Handler<Watch> for ServerMonitor {
    type Result = ();

    fn handle(&mut self, watch: Watch, ctx: &mut Self::Context) {
        self.watch = watch;
        self.begin(ctx);
    }
}

impl Handler<Forget> for ServerMonitor {
    type Result = ();

    fn handle(&mut self, _: Forget, ctx: &mut Self::Context) {
        ctx.stop();
    }
}

async fn exchange(client: &awc::Client, url: &str, load_only: bool) -> Result<Answer, Unreachable> {
    if !load_only && let Some(body) = get(client, &format!("{url}/status")).await? {
        return parse_status(&body).map(Answer::Status);
    }
    let body = get(client, &format!("{url}/load")).await?;
    let body = body.ok_or_else(|| Unreachable::BadAnswer("it has neither /status nor /load".to_owned()))?;
    let load = Load::parse(&body).map_err(|error| Unreachable::BadAnswer(shortened(&error.to_string())))?;
    plausible(load).map(Answer::Load)
}

/// The body of a page; nothing where the server says that there is none.
async fn get(client: &awc::Client, url: &str) -> Result<Option<actix_web::web::Bytes>, Unreachable> {
    let answer = match client.get(url).send().await {
        // A connection that was kept may have ended just now: that says nothing of the server.
        Err(error) if is_broken(&error) => client.get(url).send().await,
        answer => answer,
    }
    .map_err(no_answer)?;
    let status = answer.status();
    if NO_SUCH_PAGE.contains(&status) {
        return Ok(None);
    }
    if !status.is_success() {
        return Err(Unreachable::BadAnswer(format!("status {status}")));
    }
    let body = answer.timeout(NEVER).body().limit(LARGEST_ANSWER).await;
    body.map(Some).map_err(|error| Unreachable::BadAnswer(shortened(&error.to_string())))
}

/// Whether a connection ended, as opposed to one that could not be made.
fn is_broken(error: &SendRequestError) -> bool {
    !matches!(error, SendRequestError::Connect(reason) if !matches!(reason, ConnectError::Disconnected))
}

fn no_answer(error: SendRequestError) -> Unreachable {
    Unreachable::Refused(match error {
        SendRequestError::Connect(ConnectError::Disconnected) => "it was closed without an answer".to_owned(),
        error => tls::reason(&error).unwrap_or_else(|| shortened(&error.to_string())),
    })
}

/// Some servers of the Python family have a `/status` with less in it; a page that is no status at all counts as none.
fn parse_status(body: &[u8]) -> Result<ServerReport, Unreachable> {
    let report = ServerReport::parse(body).map_err(|error| {
        let text = String::from_utf8_lossy(body.get(..body.len().min(40)).unwrap_or_default()).into_owned();
        Unreachable::BadAnswer(shortened(&format!("{error} in {text:?}")))
    })?;
    plausible(report.load)?;
    match &report.problem {
        Some(problem) => Err(Unreachable::NotReady(shortened(problem))),
        None => Ok(report),
    }
}

fn plausible(load: Load) -> Result<Load, Unreachable> {
    let is_none = load.percent() > LARGEST_LOAD;
    if is_none { Err(Unreachable::BadAnswer(shortened(&format!("a load of {load} %")))) } else { Ok(load) }
}

/// Words that may hold what somebody else wrote are kept short.
fn shortened(text: &str) -> String {
    one_line(text).chars().take(120).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_needs_a_load_that_is_one() {
        let status =
            parse_status(br#"{"load": 12.5, "allowedRepositories": ["https://github.com/lab"], "new": 1}"#).unwrap();
        assert!((status.load.percent() - 12.5).abs() < f64::EPSILON);
        assert_eq!(status.allowed_repositories.len(), 1);
        for odd in [
            "",
            "{}",
            "[]",
            "12",
            "[12]",
            r#"{"load": 1} x"#,
            r#"{"load": 1, "instances": [0, 0, 0, 0, 9, 5]}"#,
            r#"{"load": -1}"#,
            r#"{"load": "1"}"#,
            r#"{"load": null}"#,
            r#"{"load": 1e308}"#,
            "<html>",
            "\u{0}",
        ] {
            assert!(matches!(parse_status(odd.as_bytes()), Err(Unreachable::BadAnswer(_))), "{odd:?}");
        }
    }
}
