//! Finds the addresses of a simulation server's name, for one monitor.
//!
//! The system resolves a name in a thread that can't be cancelled. A monitor that gives up waiting leaves the thread
//! behind; if each try started another one, a name server that hangs would use up all threads, also those for servers
//! that are well. So there is one lookup at a time, for which all wait, and while it takes long the last answer is used.
//!
//! The key `nameServers` comes first: its DNS servers may be the only ones that know the targets of their services. Then the
//! system is asked, for it also knows names from other sources: hosts, mDNS, directories.

use std::cell::RefCell;
use std::error::Error;
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use actix_tls::connect::Resolve;
use futures_util::FutureExt;
use futures_util::future::{LocalBoxFuture, Shared};
use hickory_resolver::proto::rr::RData;

use super::name_servers::{LookupError, Question, ask};
use crate::session::config::NameServer;

/// How long an answer is cached.
const TIME_TO_LIVE: Duration = Duration::from_secs(10);
/// How long a lookup may take before the last answer is used in its place.
const SLOW: Duration = Duration::from_millis(500);
/// How long the name servers may take before the system is asked.
const NAME_SERVERS: Duration = Duration::from_secs(2);

type Answer = Result<Vec<SocketAddr>, Fault>;

/// Why there is no address.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{words}")]
struct Fault {
    words: String,
    /// Whether that may be the fault of a name server, so that the last answer still holds.
    last_holds: bool,
}

/// A resolver for the name of one server.
pub struct CachingResolver {
    name_servers: Vec<NameServer>,
    cached: RefCell<Option<(Vec<SocketAddr>, Instant)>>,
    running: RefCell<Option<Shared<LocalBoxFuture<'static, Answer>>>>,
}

impl CachingResolver {
    /// A resolver that asks these name servers first.
    #[must_use]
    pub fn new(name_servers: Vec<NameServer>) -> Self {
        Self { name_servers, cached: RefCell::default(), running: RefCell::default() }
    }

    /// Returns the lookup that is running, or starts one.
    fn join_or_start(&self, host: &str, port: u16) -> Shared<LocalBoxFuture<'static, Answer>> {
        let mut running = self.running.borrow_mut();
        if let Some(lookup) = running.as_ref().filter(|lookup| lookup.peek().is_none()) {
            return lookup.clone();
        }
        let lookup = actix_rt::spawn(find(host.to_owned(), port, self.name_servers.clone()));
        let broken = |words: String| Err(Fault { words, last_holds: false });
        let lookup = lookup.map(move |ended| ended.unwrap_or_else(|error| broken(error.to_string())));
        let lookup = lookup.boxed_local().shared();
        running.replace(lookup.clone());
        lookup
    }
}

impl Resolve for CachingResolver {
    fn lookup<'a>(&'a self, host: &'a str, port: u16) -> LocalBoxFuture<'a, Result<Vec<SocketAddr>, Box<dyn Error>>> {
        Box::pin(async move {
            let cached = self.cached.borrow().clone();
            let answer = match cached {
                Some((addresses, at)) if at.elapsed() < TIME_TO_LIVE => return Ok(addresses),
                Some((addresses, _)) => {
                    let lookup = self.join_or_start(host, port);
                    match actix_rt::time::timeout(SLOW, lookup).await {
                        Err(_) | Ok(Err(Fault { last_holds: true, .. })) => Ok(addresses),
                        Ok(answer) => answer,
                    }
                }
                None => self.join_or_start(host, port).await,
            };
            let addresses = answer?;
            self.cached.replace(Some((addresses.clone(), Instant::now())));
            Ok(addresses)
        })
    }
}

/// Asks the name servers, then the system.
async fn find(host: String, port: u16, name_servers: Vec<NameServer>) -> Answer {
    let asked = ask_name_servers(&host, &name_servers).await;
    if let Ok(addresses) = asked {
        return Ok(addresses.into_iter().map(|address| SocketAddr::new(address, port)).collect());
    }
    // As one text, because an IPv6 address has brackets here.
    let found = tokio::net::lookup_host(format!("{host}:{port}")).await;
    found.map(Iterator::collect).map_err(|error| match asked {
        Err(LookupError::NoAnswer(reason)) => {
            Fault { words: format!("{error}; of nameServers: {reason}"), last_holds: true }
        }
        _ => Fault { words: error.to_string(), last_holds: false },
    })
}

/// The addresses that the name servers know, those of IPv4 first: not every machine has IPv6.
async fn ask_name_servers(host: &str, name_servers: &[NameServer]) -> Result<Vec<IpAddr>, LookupError> {
    if name_servers.is_empty() || host.starts_with('[') {
        return Err(LookupError::Nothing);
    }
    let asked = actix_rt::time::timeout(NAME_SERVERS, ask(Question::Addresses(host), name_servers)).await;
    let late = || Err(LookupError::NoAnswer("request timed out".to_owned()));
    let answer = asked.unwrap_or_else(|_| late())?;
    Ok(answer.records.iter().filter_map(RData::ip_addr).collect())
}
