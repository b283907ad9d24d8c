//! Resolves the names and hosts of simulation servers by the system's configuration: `/etc/hosts` and
//! `/etc/resolv.conf`.
//!
//! The system's `getaddrinfo` blocks a thread for each lookup and can't be cancelled: a DNS server that hangs would use
//! up all threads.

use std::cell::RefCell;
use std::error::Error;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use actix_tls::connect::Resolve;
use futures_util::future::LocalBoxFuture;
use hickory_resolver::TokioResolver;
use hickory_resolver::config::{LookupIpStrategy, ResolverConfig, ResolverOpts};
use hickory_resolver::net::NetError;
use hickory_resolver::net::runtime::TokioRuntimeProvider;
use hickory_resolver::system_conf::read_system_conf;

/// Timeout of a lookup after which the last answer is used instead.
const SLOW: Duration = Duration::from_millis(500);
/// Upper limit of the resolver's timeout for one attempt.
const TIMEOUT: Duration = Duration::from_secs(1);

/// The resolver of all hosts. Clones share its connections and its cache.
///
/// # Errors
/// When no resolver can be created.
pub fn resolver() -> std::io::Result<TokioResolver> {
    let (config, mut options) = read_system_conf().unwrap_or_else(|error| {
        log::warn!("/etc/resolv.conf can't be used, only /etc/hosts is: {error}");
        (ResolverConfig::from_name_servers(Vec::new()), ResolverOpts::default())
    });
    // Two attempts fit into the timeout of a probe (`timing.answer`).
    options.timeout = options.timeout.min(TIMEOUT);
    build(config, options).map_err(std::io::Error::other)
}

fn build(config: ResolverConfig, mut options: ResolverOpts) -> Result<TokioResolver, NetError> {
    options.ip_strategy = LookupIpStrategy::Ipv4AndIpv6;
    TokioResolver::builder_with_config(config, TokioRuntimeProvider::default()).with_options(options).build()
}

/// Resolves a name to its current addresses, at least one.
///
/// Each lookup creates its own resolver: orchestrators publish TTLs of minutes, and dnsmasq answers on a kept
/// connection with what it knew when the connection began.
///
/// # Errors
/// As text, when there is no answer or no address in it.
pub async fn look_up(name: &str) -> Result<Vec<IpAddr>, String> {
    let resolver = read_system_conf().and_then(|(config, options)| build(config, options));
    look_up_by(&resolver.map_err(|error| error.to_string())?, name).await
}

async fn look_up_by(resolver: &TokioResolver, name: &str) -> Result<Vec<IpAddr>, String> {
    match resolver.lookup_ip(name).await {
        Ok(found) => Ok(found.iter().map(|address| address.to_canonical()).collect()),
        Err(error) if error.is_no_records_found() => Err("DNS has no such records".to_owned()),
        Err(error) => Err(error.to_string()),
    }
}

/// Resolves the host of one simulation server. The last answer is used while a lookup fails or takes long.
pub struct HostResolver {
    resolver: TokioResolver,
    last: RefCell<Vec<IpAddr>>,
}

impl HostResolver {
    /// Uses this resolver for the lookups.
    pub fn new(resolver: TokioResolver) -> Self {
        Self { resolver, last: RefCell::default() }
    }

    async fn addresses(&self, host: &str) -> Result<Vec<IpAddr>, String> {
        let last = self.last.borrow().clone();
        let lookup = look_up_by(&self.resolver, host.trim_matches(['[', ']']));
        let found = if last.is_empty() {
            lookup.await?
        } else {
            actix_rt::time::timeout(SLOW, lookup).await.ok().and_then(Result::ok).unwrap_or(last)
        };
        self.last.replace(found.clone());
        Ok(found)
    }
}

impl Resolve for HostResolver {
    fn lookup<'a>(&'a self, host: &'a str, port: u16) -> LocalBoxFuture<'a, Result<Vec<SocketAddr>, Box<dyn Error>>> {
        Box::pin(async move {
            let found = self.addresses(host).await?;
            Ok(found.into_iter().map(|address| SocketAddr::new(address, port)).collect())
        })
    }
}
