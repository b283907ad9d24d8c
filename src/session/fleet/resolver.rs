//! Resolves the names and hosts of simulation servers by the system's configuration: `/etc/hosts` and
//! `/etc/resolv.conf`.
//!
//! The system's `getaddrinfo` blocks a thread for each lookup and can't be cancelled: a DNS server that hangs would use
//! up all threads.

use std::error::Error;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use actix_tls::connect::Resolve;
use futures_util::future::LocalBoxFuture;
use hickory_resolver::TokioResolver;
use hickory_resolver::config::{LookupIpStrategy, ResolverConfig};
use hickory_resolver::net::NetError;
use hickory_resolver::net::runtime::TokioRuntimeProvider;

/// Upper limit of the resolver's timeout for one attempt: two fit into the timeout of a probe (`timing.answer`).
const TIMEOUT: Duration = Duration::from_secs(1);

/// Resolves a name to its current addresses, at least one.
///
/// Each lookup creates its own resolver, without a cache: orchestrators publish TTLs of minutes, and dnsmasq answers on
/// a kept connection with the records from when the connection began.
///
/// # Errors
/// As text, when there is no answer or no address in it.
pub async fn look_up(name: &str) -> Result<Vec<IpAddr>, String> {
    let found = async {
        // Without /etc/resolv.conf, only /etc/hosts is used.
        let mut builder = TokioResolver::builder_tokio().unwrap_or_else(|_| {
            let none = ResolverConfig::from_name_servers(Vec::new());
            TokioResolver::builder_with_config(none, TokioRuntimeProvider::default())
        });
        let options = builder.options_mut();
        options.timeout = options.timeout.min(TIMEOUT);
        options.ip_strategy = LookupIpStrategy::Ipv4AndIpv6;
        builder.build()?.lookup_ip(name).await
    };
    let found = found.await.map_err(|error: NetError| {
        if error.is_no_records_found() {
            "DNS has no such records".to_owned()
        } else {
            error.to_string()
        }
    })?;
    Ok(found.iter().map(|address| address.to_canonical()).collect())
}

/// Resolves the hosts of simulation servers.
pub struct HostResolver;

impl Resolve for HostResolver {
    fn lookup<'a>(&'a self, host: &'a str, port: u16) -> LocalBoxFuture<'a, Result<Vec<SocketAddr>, Box<dyn Error>>> {
        Box::pin(async move {
            let found = look_up(host.trim_matches(['[', ']'])).await?;
            Ok(found
                .into_iter()
                .map(|address| SocketAddr::new(address, port))
                .collect())
        })
    }
}
