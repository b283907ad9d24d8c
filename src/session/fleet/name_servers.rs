//! Asks name servers, each by itself: one that has records is enough, and of several the first in the list counts.
//!
//! The resolver's own pool takes the first answer of several servers, also where that is an error. One server of two that
//! fails, or knows others than the other while a change is on its way to it, would make each name come and go.

use std::collections::BTreeSet;
use std::pin::pin;
use std::time::Duration;

use futures_util::StreamExt;
use futures_util::future::{Either, select};
use futures_util::stream::FuturesUnordered;
use hickory_resolver::TokioResolver;
use hickory_resolver::config::{ConnectionConfig, NameServerConfig, ResolveHosts, ResolverConfig, ResolverOpts};
use hickory_resolver::net::NetError;
use hickory_resolver::net::runtime::TokioRuntimeProvider;
use hickory_resolver::proto::rr::{RData, RecordType};
use hickory_resolver::system_conf::read_system_conf;
use tokio::time::{Instant, timeout_at};

use crate::session::config::NameServer;

/// What is asked for.
#[derive(Debug, Clone, Copy)]
pub enum Question<'a> {
    /// The addresses of this host.
    Addresses(&'a str),
    /// The targets of this service.
    Service(&'a str),
}

/// What a name server has told.
#[derive(Debug)]
pub struct Answer {
    /// Records of the kinds that were asked for. There is at least one.
    pub records: Vec<RData>,
    /// Whether that is all: IPv6 addresses may be missing.
    pub complete: bool,
}

/// Why a name leads to nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LookupError {
    /// The answer of all name servers is that there is nothing.
    #[error("DNS has no such records")]
    Nothing,
    /// No name server gave an answer that can be used.
    #[error("{0}")]
    NoAnswer(String),
}

/// How long a name server may take for one answer; it is asked twice.
const ANSWER: Duration = Duration::from_secs(2);
/// How long IPv6 addresses may take when there are others.
const IPV6: Duration = Duration::from_millis(500);
/// How long those earlier in the list may take when another has answered.
const EARLIER: Duration = Duration::from_millis(500);

/// Asks these name servers, or those of the machine where there are none.
///
/// The resolvers are made anew each time: the answer shall be that of now, and the machine's configuration may have changed.
///
/// # Errors
/// When no name server has such records: [`LookupError::Nothing`] where all say so.
pub async fn ask(question: Question<'_>, name_servers: &[NameServer]) -> Result<Answer, LookupError> {
    let resolvers = resolvers(name_servers).map_err(no_answer)?;
    let ask = async |(place, resolver)| (place, ask_one(question, resolver).await);
    let mut answers: FuturesUnordered<_> = resolvers.iter().enumerate().map(ask).collect();
    let mut waiting: BTreeSet<usize> = (0..resolvers.len()).collect();
    let (mut best, mut fault): (Option<(usize, Answer)>, _) = (None, LookupError::Nothing);
    let mut until = Instant::now();
    loop {
        // Nobody is waited for who comes after it in the list, and those before it only so long.
        let next = match &best {
            Some((place, _)) if waiting.range(..place).next().is_none() => break,
            Some(_) => timeout_at(until, answers.next()).await.ok().flatten(),
            None => answers.next().await,
        };
        let Some((place, answer)) = next else { break };
        waiting.remove(&place);
        match answer {
            Ok(answer) if best.as_ref().is_none_or(|(best, _)| place < *best) => {
                if best.is_none() {
                    until = Instant::now() + EARLIER;
                }
                best = Some((place, answer));
            }
            // One that fails may know the name.
            Err(error) if fault == LookupError::Nothing => fault = error,
            _ => {}
        }
    }
    best.map(|(_, answer)| answer).ok_or(fault)
}

async fn ask_one(question: Question<'_>, resolver: &TokioResolver) -> Result<Answer, LookupError> {
    let answer = match question {
        Question::Addresses(host) => addresses(host, resolver).await?,
        Question::Service(name) => Answer { records: records(name, RecordType::SRV, resolver).await?, complete: true },
    };
    if answer.records.is_empty() { Err(LookupError::Nothing) } else { Ok(answer) }
}

/// All addresses of a host. Those of IPv4 are enough, for some name servers fail when they are asked for others.
async fn addresses(host: &str, resolver: &TokioResolver) -> Result<Answer, LookupError> {
    let v4 = pin!(records(host, RecordType::A, resolver));
    let v6 = pin!(records(host, RecordType::AAAA, resolver));
    let (v4, v6) = match select(v4, v6).await {
        Either::Left((Ok(v4), v6)) if !v4.is_empty() => {
            let late = || Err(LookupError::NoAnswer("request timed out".to_owned()));
            (v4, actix_rt::time::timeout(IPV6, v6).await.unwrap_or_else(|_| late()))
        }
        Either::Left((v4, v6)) => (v4?, v6.await),
        Either::Right((v6, v4)) => (v4.await?, v6),
    };
    match v6 {
        Err(_) if !v4.is_empty() => Ok(Answer { records: v4, complete: false }),
        v6 => Ok(Answer { records: [v4, v6?].concat(), complete: true }),
    }
}

/// The records of one kind; none where the answer is that there are none.
async fn records(name: &str, kind: RecordType, resolver: &TokioResolver) -> Result<Vec<RData>, LookupError> {
    match resolver.lookup(name, kind).await {
        // Others, such as aliases on the way, may be among them.
        Ok(found) => {
            let data = found.answers().iter().map(|record| &record.data);
            Ok(data.filter(|data| data.record_type() == kind).cloned().collect())
        }
        Err(error) if error.is_no_records_found() => Ok(Vec::new()),
        Err(error) => Err(no_answer(error)),
    }
}

/// One resolver for each name server.
fn resolvers(name_servers: &[NameServer]) -> Result<Vec<TokioResolver>, NetError> {
    let (config, mut options) = if name_servers.is_empty() {
        read_system_conf()?
    } else {
        let servers = name_servers.iter().map(server).collect();
        (ResolverConfig::from_name_servers(servers), ResolverOpts::default())
    };
    options.use_hosts_file = ResolveHosts::Never;
    options.cache_size = 0;
    options.timeout = ANSWER;
    options.attempts = 1;
    let (domain, search, servers) = config.into_parts();
    let resolver = |server| {
        let config = ResolverConfig::from_parts(domain.clone(), search.clone(), vec![server]);
        let builder = TokioResolver::builder_with_config(config, TokioRuntimeProvider::default());
        builder.with_options(options.clone()).build()
    };
    servers.into_iter().map(resolver).collect()
}

fn server(NameServer(address): &NameServer) -> NameServerConfig {
    let mut connections = vec![ConnectionConfig::udp(), ConnectionConfig::tcp()];
    for connection in &mut connections {
        connection.port = address.port();
    }
    NameServerConfig::new(address.ip(), true, connections)
}

#[expect(clippy::needless_pass_by_value, reason = "it is given to map_err")]
fn no_answer(error: NetError) -> LookupError {
    LookupError::NoAnswer(error.to_string())
}
