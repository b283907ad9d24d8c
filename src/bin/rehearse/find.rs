//! Grows a class, one client after the other, until simulations are slower than real time: how many fit on each
//! simulation server.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::time::Duration;

use futures_util::StreamExt;
use futures_util::future::abortable;
use futures_util::stream::FuturesUnordered;

use crate::arguments::Arguments;
use crate::behaviour::Behaviour;
use crate::board::Board;
use crate::browser::Browser;
use crate::interruption::interruption;
use crate::paces::Paces;
use crate::real_time_factors::sorted;
use crate::session_server::SessionServer;
use crate::visit::{Outcome, Visit};

/// One client of this many may be slow: 95 % keep real time.
const MAY_BE_SLOW: usize = 20;
/// Number of clients in a row that are sent to servers on which no more fit, until the class does not grow any more.
const IN_VAIN: u32 = 3;
/// The longest time that one client waits for its simulation.
const PATIENCE: Duration = Duration::from_mins(1);
/// How long clients stay if nothing ends the search.
const STAY: Duration = Duration::from_hours(24);
/// Interval between two looks whether a client has settled.
const LOOK: Duration = Duration::from_millis(100);

/// How many fit on one simulation server.
#[derive(Debug, Default, Clone, PartialEq)]
struct Capacity {
    fit: usize,
    /// The number of clients with which real time was not kept, and the pace that 95 % of them had at least.
    broken: Option<(usize, f64)>,
}

/// The result.
#[derive(Debug, Default)]
pub(crate) struct Found {
    servers: BTreeMap<String, Capacity>,
    /// Why the class did not grow any more.
    end: String,
    /// Whether Ctrl-C or SIGTERM ended the search.
    pub(crate) interrupted: bool,
}

/// What has become of a client.
enum Settled {
    Runs(String),
    Ended(String),
}

impl Capacity {
    /// Takes in the paces of all clients of the server. Returns whether they fit.
    fn take_in(&mut self, paces: Vec<f64>, real_time: f64) -> bool {
        let count = paces.len();
        let paces = sorted(paces.into_iter());
        let pace = paces.get(count / MAY_BE_SLOW).copied().unwrap_or_default();
        let fits = self.broken.is_none() && pace >= real_time;
        if fits {
            self.fit = count;
        } else if self.broken.is_none() {
            self.broken = Some((count, pace));
        }
        fits
    }
}

/// Lets clients come one after the other, each as soon as the one before has settled, and stay.
pub(crate) async fn find(arguments: &Arguments) -> Found {
    let mut found = Found::default();
    let end = tokio::select! {
        end = grow(arguments, &mut found.servers) => Some(end),
        () = interruption() => None,
    };
    found.interrupted = end.is_none();
    found.end = end.unwrap_or_else(|| "It was interrupted".to_owned());
    found
}

/// Returns why the class does not grow any more.
async fn grow(arguments: &Arguments, servers: &mut BTreeMap<String, Capacity>) -> String {
    let arguments = Arguments {
        patience: arguments.patience.min(PATIENCE),
        ..arguments.clone()
    };
    let (board, session_server) = (Board::new(), SessionServer::new(&arguments.fleet));
    let (visits, paces) = (RefCell::default(), Paces::default());
    let mut seats = FuturesUnordered::new();
    let mut in_vain = 0;
    for client in 0..arguments.clients {
        let who = (client, Behaviour::Ordinary, STAY);
        let browser = Browser::new(&arguments, &board, &session_server, (&visits, &paces), who);
        let (seat, leave) = abortable(browser.visit(|_| {}));
        seats.push(seat);
        let settled = settle(client, &paces, &visits);
        futures_util::pin_mut!(settled);
        let settled = loop {
            tokio::select! {
                Some(_) = seats.next() => {}
                settled = &mut settled => break settled,
            }
        };
        let server = match settled {
            Settled::Runs(server) => server,
            Settled::Ended(why) => return format!("Client {} got no simulation that runs: {why}", client + 1),
        };
        let capacity = servers.entry(server.clone()).or_default();
        let fits = capacity.take_in(paces.of(&server), arguments.real_time);
        eprintln!("{:>4}  {server}: {capacity}", client + 1);
        in_vain = if fits { 0 } else { in_vain + 1 };
        if in_vain == IN_VAIN {
            return "Clients are sent only to servers on which no more fit".to_owned();
        }
        if !fits {
            // So that the others keep real time.
            leave.abort();
        }
    }
    format!("All {} clients of --clients have come", arguments.clients)
}

/// Waits until the simulation of a client has run for some seconds, or the client has got none.
async fn settle(client: u32, paces: &Paces, visits: &RefCell<Vec<Visit>>) -> Settled {
    loop {
        if let Some(server) = paces.settled(client) {
            return Settled::Runs(server);
        }
        let ended = visits.borrow().iter().find(|visit| visit.client == client).cloned();
        if let Some(visit) = ended {
            return Settled::Ended(match visit.outcome {
                Outcome::BrokeOff(why) | Outcome::Refused(why) | Outcome::Failed(why) => why,
                Outcome::Ran | Outcome::Unseen | Outcome::Left => "it has left".to_owned(),
            });
        }
        actix_rt::time::sleep(LOOK).await;
    }
}

impl std::fmt::Display for Capacity {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "{} fit", self.fit)?;
        match self.broken {
            Some((count, pace)) => write!(out, ", with {count} real time is {pace:.2}"),
            None => write!(out, ", perhaps more"),
        }
    }
}

impl Found {
    /// The number of clients that fit on all servers.
    pub(crate) fn fit(&self) -> usize {
        self.servers.values().map(|capacity| capacity.fit).sum()
    }

    /// The result as text.
    pub(crate) fn text(&self) -> String {
        let mut text = String::new();
        for (server, capacity) in &self.servers {
            // Writing into a text can't fail.
            writeln!(text, "{server}: {capacity}; \"maxConnections\": {}", capacity.fit).ok();
        }
        write!(text, "{}. {} fit.", self.end.trim_end_matches('.'), self.fit()).ok();
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_is_full_once_too_many_are_slow() {
        let mut capacity = Capacity::default();
        assert!(capacity.take_in(vec![1.0; 18], 0.9));
        let mut paces = vec![1.0; 18];
        paces.push(0.5);
        assert!(!capacity.take_in(paces.clone(), 0.9));
        assert_eq!(capacity.to_string(), "18 fit, with 19 real time is 0.50");
        assert!(!capacity.take_in(vec![1.0; 19], 0.9), "it stays so");
        let mut other = Capacity::default();
        paces.push(1.0);
        assert!(other.take_in(paces, 0.9), "one of twenty may be slow");
        assert_eq!(other.to_string(), "20 fit, perhaps more");
    }
}
