//! Actor: looks one name of `simulationServers` up, again and again.
//!
//! Created by the registry for each name. It asks DNS every second, whatever time to live an answer has: engines give their
//! names minutes, and a new server shall be used within five seconds of its start. The result goes to the registry, which judges it.
//! The monitor ends when the registry says so; after a panic the registry starts a new one.

use std::time::Duration;

use actix::prelude::*;

use super::lookup::{Found, look_up};
use super::name_servers::LookupError;
use super::server_monitor::Stop;
use crate::session::config::{DnsName, NameServer};

/// What looking a name up brought.
#[derive(Message, Debug)]
#[rtype(result = "()")]
pub struct LookupResult {
    /// The name.
    pub name: DnsName,
    /// What it leads to, or why that is not known.
    pub answer: Result<Found, LookupError>,
}

/// The actor.
pub struct NameMonitor {
    name: DnsName,
    name_servers: Vec<NameServer>,
    results: Recipient<LookupResult>,
}

/// Between the end of a lookup and the next one.
const PAUSE: Duration = Duration::from_secs(1);
/// How long a lookup as a whole may take.
const TIME_LIMIT: Duration = Duration::from_secs(5);

impl NameMonitor {
    /// A monitor of one name, which asks these name servers, or those of the machine where there are none.
    #[must_use]
    pub fn new(name: DnsName, name_servers: Vec<NameServer>, results: Recipient<LookupResult>) -> Self {
        Self { name, name_servers, results }
    }

    fn look_up(&mut self, ctx: &mut Context<Self>) {
        let (name, name_servers) = (self.name.clone(), self.name_servers.clone());
        async move { actix_rt::time::timeout(TIME_LIMIT, look_up(&name, &name_servers)).await }
            .into_actor(self)
            .map(|answer, monitor, ctx| {
                let late = LookupError::NoAnswer(format!("no answer within {} s", TIME_LIMIT.as_secs_f64()));
                let answer = answer.unwrap_or(Err(late));
                match monitor.results.try_send(LookupResult { name: monitor.name.clone(), answer }) {
                    // One that is lost is followed by another.
                    Ok(()) | Err(SendError::Full(_)) => {
                        ctx.run_later(PAUSE, Self::look_up);
                    }
                    // The registry is gone, and with it the server.
                    Err(SendError::Closed(_)) => ctx.stop(),
                }
            })
            .spawn(ctx);
    }
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
