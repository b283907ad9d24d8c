//! Finds the addresses of a simulation server's name, for one monitor.
//!
//! The system resolves a name in a thread that can't be cancelled. A monitor that gives up waiting leaves the thread
//! behind; if each try started another one, a name server that hangs would use up all threads, also those for servers
//! that are well. So there is one lookup at a time, for which all wait, and while it takes long the last answer is used.
//!
//! The system is asked, and not a DNS server, because it also knows names from other sources: hosts, mDNS, directories.

use std::cell::RefCell;
use std::error::Error;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use actix_tls::connect::Resolve;
use futures_util::FutureExt;
use futures_util::future::{LocalBoxFuture, Shared};

/// How long an answer is cached.
const TIME_TO_LIVE: Duration = Duration::from_secs(10);
/// How long a lookup may take before the last answer is used in its place.
const SLOW: Duration = Duration::from_millis(500);

type Answer = Result<Vec<SocketAddr>, String>;

/// A resolver for the name of one server.
#[derive(Default)]
pub struct CachingResolver {
    cached: RefCell<Option<(Vec<SocketAddr>, Instant)>>,
    running: RefCell<Option<Shared<LocalBoxFuture<'static, Answer>>>>,
}

impl CachingResolver {
    /// Returns the lookup that is running, or starts one.
    fn join_or_start(&self, host: &str, port: u16) -> Shared<LocalBoxFuture<'static, Answer>> {
        let mut running = self.running.borrow_mut();
        if let Some(lookup) = running.as_ref().filter(|lookup| lookup.peek().is_none()) {
            return lookup.clone();
        }
        // As one text, because an IPv6 address has brackets here.
        let name = format!("{host}:{port}");
        let lookup = actix_rt::spawn(async move {
            let found = tokio::net::lookup_host(name).await;
            found.map(Iterator::collect).map_err(|error| error.to_string())
        });
        let lookup = lookup.map(|ended| ended.unwrap_or_else(|error| Err(error.to_string()))).boxed_local().shared();
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
                    actix_rt::time::timeout(SLOW, lookup).await.unwrap_or(Ok(addresses))
                }
                None => self.join_or_start(host, port).await,
            };
            let addresses = answer?;
            self.cached.replace(Some((addresses.clone(), Instant::now())));
            Ok(addresses)
        })
    }
}
