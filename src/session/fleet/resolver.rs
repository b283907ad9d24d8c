//! Finds the addresses of a simulation server's name, for one monitor.
//!
//! The system resolves names in a thread that nobody can call back. A look that is given up leaves it behind, and were
//! each look to start another, a name server that hangs would use up all threads, and with them the looks at servers
//! that are well. So one lookup is under way at most, and whoever comes meanwhile waits for the same; what was found
//! before serves while it takes long.

use std::cell::RefCell;
use std::error::Error;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use actix_tls::connect::Resolve;
use futures_util::FutureExt;
use futures_util::future::{LocalBoxFuture, Shared};

/// For how long an answer is good.
const GOOD: Duration = Duration::from_secs(10);
/// After how long what was found before will do.
const LONG: Duration = Duration::from_millis(500);

type Answer = Result<Vec<SocketAddr>, String>;

/// The name of one server.
#[derive(Default)]
pub struct Names {
    found: RefCell<Option<(Vec<SocketAddr>, Instant)>>,
    under_way: RefCell<Option<Shared<LocalBoxFuture<'static, Answer>>>>,
}

impl Names {
    /// The lookup that is under way, or another one.
    fn join_or_start(&self, host: &str, port: u16) -> Shared<LocalBoxFuture<'static, Answer>> {
        let mut under_way = self.under_way.borrow_mut();
        if let Some(lookup) = under_way.as_ref().filter(|lookup| lookup.peek().is_none()) {
            return lookup.clone();
        }
        // As one text, for an IPv6 address has brackets here.
        let name = format!("{host}:{port}");
        let lookup = actix_rt::spawn(async move {
            let found = tokio::net::lookup_host(name).await;
            found.map(Iterator::collect).map_err(|error| error.to_string())
        });
        let lookup = lookup.map(|ended| ended.unwrap_or_else(|error| Err(error.to_string()))).boxed_local().shared();
        under_way.replace(lookup.clone());
        lookup
    }
}

impl Resolve for Names {
    fn lookup<'a>(&'a self, host: &'a str, port: u16) -> LocalBoxFuture<'a, Result<Vec<SocketAddr>, Box<dyn Error>>> {
        Box::pin(async move {
            let found = self.found.borrow().clone();
            let answer = match found {
                Some((addresses, at)) if at.elapsed() < GOOD => return Ok(addresses),
                Some((addresses, _)) => {
                    let lookup = self.join_or_start(host, port);
                    actix_rt::time::timeout(LONG, lookup).await.unwrap_or(Ok(addresses))
                }
                None => self.join_or_start(host, port).await,
            };
            let addresses = answer?;
            self.found.replace(Some((addresses.clone(), Instant::now())));
            Ok(addresses)
        })
    }
}
