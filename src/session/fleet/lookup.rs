//! Asks DNS which simulation servers a name leads to.

use std::collections::BTreeSet;
use std::net::IpAddr;
use std::time::Duration;

use hickory_resolver::TokioResolver;
use hickory_resolver::config::{ConnectionConfig, NameServerConfig, ResolveHosts, ResolverConfig};
use hickory_resolver::lookup::Lookup;
use hickory_resolver::net::NetError;
use hickory_resolver::net::runtime::TokioRuntimeProvider;
use hickory_resolver::proto::rr::{RData, RecordType};

use crate::session::config::{DnsName, NameServer};
use crate::shared::domain::PublicAddress;

/// What a name leads to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// The simulation servers. There is at least one.
    pub servers: BTreeSet<PublicAddress>,
}

/// Why a name leads to nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LookupError {
    /// The name server's answer is that there is nothing.
    #[error("DNS has no such records")]
    Nothing,
    /// No name server gave an answer that can be used.
    #[error("{0}")]
    NoAnswer(String),
}

/// How long a name server may take for one answer; it is asked twice.
const ANSWER: Duration = Duration::from_secs(2);

/// Asks these name servers, or those of the machine where there are none.
///
/// The resolver is made anew each time: the answer shall be that of now, and the machine's configuration may have changed.
///
/// # Errors
/// When there is no answer to all questions, or nothing in them.
pub async fn look_up(name: &DnsName, name_servers: &[NameServer]) -> Result<Found, LookupError> {
    let resolver = resolver(name_servers).map_err(no_answer)?;
    let mut answers = Vec::new();
    match name {
        DnsName::Addresses { host, .. } => {
            let (v4, v6) = futures_util::join!(
                resolver.lookup(host.as_str(), RecordType::A),
                resolver.lookup(host.as_str(), RecordType::AAAA)
            );
            // Half an answer would be worse than none: the servers of the other half would count as gone.
            answers.extend(records(v4)?);
            answers.extend(records(v6)?);
        }
        DnsName::Service(name) => answers.extend(records(resolver.lookup(name.as_str(), RecordType::SRV).await)?),
    }
    let data = answers.iter().flat_map(Lookup::answers).map(|record| &record.data);
    let servers: BTreeSet<PublicAddress> = data.filter_map(|data| server(name, data)).collect();
    if servers.is_empty() { Err(LookupError::Nothing) } else { Ok(Found { servers }) }
}

fn resolver(name_servers: &[NameServer]) -> Result<TokioResolver, NetError> {
    let mut builder = if name_servers.is_empty() {
        TokioResolver::builder_tokio()?
    } else {
        let servers = name_servers.iter().map(|NameServer(address)| {
            let mut connections = vec![ConnectionConfig::udp(), ConnectionConfig::tcp()];
            for connection in &mut connections {
                connection.port = address.port();
            }
            NameServerConfig::new(address.ip(), true, connections)
        });
        let config = ResolverConfig::from_name_servers(servers.collect());
        TokioResolver::builder_with_config(config, TokioRuntimeProvider::default())
    };
    let options = builder.options_mut();
    options.use_hosts_file = ResolveHosts::Never;
    options.cache_size = 0;
    options.timeout = ANSWER;
    options.attempts = 1;
    builder.build()
}

/// The answer; none where it is that there are no such records.
fn records(answer: Result<Lookup, NetError>) -> Result<Option<Lookup>, LookupError> {
    match answer {
        Ok(lookup) => Ok(Some(lookup)),
        Err(error) if error.is_no_records_found() => Ok(None),
        Err(error) => Err(no_answer(error)),
    }
}

#[expect(clippy::needless_pass_by_value, reason = "it is given to map_err")]
fn no_answer(error: NetError) -> LookupError {
    LookupError::NoAnswer(error.to_string())
}

/// The simulation server that a record stands for. Records of other kinds, such as aliases on the way, stand for none.
fn server(name: &DnsName, data: &RData) -> Option<PublicAddress> {
    let address = match data {
        RData::A(address) => IpAddr::from(address.0),
        RData::AAAA(address) => IpAddr::from(address.0).to_canonical(),
        // The name is kept, for that is what a certificate is for.
        RData::SRV(target) => return format!("{}:{}", target.target, target.port).parse().ok(),
        _ => return None,
    };
    let DnsName::Addresses { port, .. } = name else { return None };
    let host = if address.is_ipv6() { format!("[{address}]") } else { address.to_string() };
    Some(PublicAddress::new(&host, *port, false))
}
