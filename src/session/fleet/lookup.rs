//! Asks DNS which simulation servers a name leads to.

use std::collections::BTreeSet;
use std::net::IpAddr;

use hickory_resolver::proto::rr::RData;

use super::name_servers::{LookupError, Question, ask};
use crate::session::config::{DnsName, NameServer};
use crate::shared::domain::PublicAddress;

/// What a name leads to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// The simulation servers. There is at least one.
    pub servers: BTreeSet<PublicAddress>,
    /// Whether these are all: those with IPv6 addresses may be missing.
    pub complete: bool,
}

/// Asks these name servers, or those of the machine where there are none.
///
/// # Errors
/// When there is no answer, or nothing in it.
pub async fn look_up(name: &DnsName, name_servers: &[NameServer]) -> Result<Found, LookupError> {
    let question = match name {
        DnsName::Addresses { host, .. } => Question::Addresses(host),
        DnsName::Service(name) => Question::Service(name),
    };
    let answer = ask(question, name_servers).await?;
    let servers: BTreeSet<PublicAddress> = answer.records.iter().filter_map(|data| server(name, data)).collect();
    if servers.is_empty() { Err(LookupError::Nothing) } else { Ok(Found { servers, complete: answer.complete }) }
}

/// The simulation server that a record stands for.
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
