//! Actor: resolves one name of `simulationServers` periodically.
//!
//! Created by the registry for each name. It queries DNS every second regardless of TTL, and sends the result to the
//! registry. The monitor ends when the registry stops it; after a panic the registry starts a new one.

use std::collections::BTreeSet;
use std::time::Duration;

use actix::prelude::*;

use super::resolver::look_up;
use super::server_monitor::Stop;
use crate::session::config::DnsName;
use crate::shared::domain::PublicAddress;

/// The result of a lookup.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub struct LookupResult {
    /// The entry of `simulationServers`.
    pub name: DnsName,
    /// The simulation servers that it resolves to, at least one; or why the lookup failed.
    pub answer: Result<BTreeSet<PublicAddress>, String>,
}

/// The actor.
pub struct NameMonitor {
    name: DnsName,
    results: Recipient<LookupResult>,
}

/// Pause between the end of a lookup and the next one.
const PAUSE: Duration = Duration::from_secs(1);

impl NameMonitor {
    /// A monitor of one name.
    pub fn new(name: DnsName, results: Recipient<LookupResult>) -> Self {
        Self { name, results }
    }

    fn look_up(&mut self, ctx: &mut Context<Self>) {
        servers(self.name.clone())
            .into_actor(self)
            .map(|answer, monitor, ctx| {
                match monitor.results.try_send(LookupResult { name: monitor.name.clone(), answer }) {
                    // A full mailbox drops this result; the next lookup replaces it.
                    Ok(()) | Err(SendError::Full(_)) => {
                        ctx.run_later(PAUSE, Self::look_up);
                    }
                    // The registry has stopped, and the server with it.
                    Err(SendError::Closed(_)) => ctx.stop(),
                }
            })
            .spawn(ctx);
    }
}

/// Resolves a name to simulation servers.
async fn servers(name: DnsName) -> Result<BTreeSet<PublicAddress>, String> {
    let addresses = look_up(&name.host).await?;
    let host = |address: std::net::IpAddr| if address.is_ipv6() { format!("[{address}]") } else { address.to_string() };
    Ok(addresses.into_iter().map(|address| PublicAddress::new(&host(address), name.port, false)).collect())
}

impl Actor for NameMonitor {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        self.look_up(ctx);
    }
}

impl Handler<Stop> for NameMonitor {
    type Result = ();

    fn handle(&mut self, _: Stop, ctx: &mut Self::Context) {
        ctx.stop();
    }
}
