//! The simulated scenarios: the machines, the number of clients, and their behaviour.

use rand::RngExt;
use rand::rngs::StdRng;

/// The load from which a server gets no clients, in percent.
pub(crate) const THRESHOLD: f64 = 95.0;
/// Seconds that a run lasts.
pub(crate) const HORIZON: f64 = 300.0;
/// When a class arrives, in seconds.
const BURST_AT: f64 = 150.0;
/// The mean length of a session, in seconds: short, so that reports are soon outdated.
const MEAN_SESSION: f64 = 100.0;
/// The share of clients that are sent to a server and never connect.
const NO_SHOW: f64 = 0.02;

/// How the clients arrive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Arrivals {
    /// One by one, up to 65 % of the fleet's capacity.
    Steady,
    /// A class in one moment, on top of some others: 200 for up to 5 servers, else 1,000.
    Moment,
    /// The same class in a minute.
    Minute,
    /// One by one, up to 130 % of the fleet's capacity.
    TooMany,
    /// One and a half times the fleet's capacity in one moment, on top of 50 %.
    Crowd,
}

impl Arrivals {
    pub(crate) const ALL: [Self; 5] = [Self::Steady, Self::Moment, Self::Minute, Self::TooMany, Self::Crowd];
}

/// How the machines differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sizes {
    /// Not at all.
    Equal,
    /// By a factor of up to 8: a client costs 1, 1.5, 2, 4 or 8 %.
    Mixed,
}

/// How the lengths of the sessions are distributed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sessions {
    /// Exponential.
    Exponential,
    /// Pareto with alpha 1.5, bounded at a hundred times the shortest.
    Heavy,
}

/// What else the machines do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Foreign {
    /// Nothing but what every machine does.
    None,
    /// Other programs, for half a minute on average, each machine once in a minute and a half.
    ComesAndGoes,
}

/// What is simulated.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scenario {
    pub(crate) arrivals: Arrivals,
    pub(crate) refresh: f64,
    pub(crate) servers: usize,
    pub(crate) sizes: Sizes,
    pub(crate) sessions: Sessions,
    pub(crate) foreign: Foreign,
    /// If the first server is a black hole, the seconds after which each start fails there.
    pub(crate) fails_after: Option<f64>,
}

/// The outcome of a run.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Outcome {
    /// The highest load that the clients on any server demanded, in percent; above 100, the server is overloaded.
    pub(crate) highest: f64,
    /// The share of all servers' time that was spent over 100 %, in percent.
    pub(crate) overload: f64,
    /// The share of requests that were refused, in percent.
    pub(crate) refused: f64,
    /// The share of requests whose starts failed in a black hole, in percent.
    pub(crate) failed: f64,
}

/// One client, drawn before the run, so that every policy gets the same clients.
pub(crate) struct Client {
    pub(crate) at: f64,
    /// Seconds until it connects to the server that it was sent to.
    pub(crate) travel: f64,
    pub(crate) comes: bool,
    /// Its cost, relative to the mean one.
    pub(crate) weight: f64,
    pub(crate) session: f64,
}

/// Draws the clients of a run. `capacity` is the number of clients that the fleet can hold.
pub(crate) fn clients(scenario: &Scenario, capacity: f64, random: &mut StdRng) -> Vec<Client> {
    let class = if scenario.servers <= 5 { 200.0 } else { 1000.0 };
    // The share of the fleet that steady arrivals fill, the number of clients in the burst, and its length in seconds.
    let (steady, besides, within) = match scenario.arrivals {
        Arrivals::Steady => (0.65, 0.0, 0.0),
        Arrivals::Moment => ((0.85 - class / capacity).clamp(0.05, 0.65), class, 0.0),
        Arrivals::Minute => ((0.85 - class / capacity).clamp(0.05, 0.65), class, 60.0),
        Arrivals::TooMany => (1.3, 0.0, 0.0),
        Arrivals::Crowd => (0.5, 1.5 * capacity, 0.0),
    };
    let mut times: Vec<f64> = (0..besides as usize)
        .map(|_| BURST_AT + within * random.random::<f64>())
        .collect();
    let rate = steady * capacity / MEAN_SESSION;
    let mut at = exponential(random) / rate;
    while at < HORIZON {
        times.push(at);
        at += exponential(random) / rate;
    }
    times.sort_by(f64::total_cmp);
    times.into_iter().map(|at| client(scenario, at, random)).collect()
}

fn client(scenario: &Scenario, at: f64, random: &mut StdRng) -> Client {
    Client {
        at,
        travel: random.random_range(0.1..1.0),
        comes: random.random::<f64>() >= NO_SHOW,
        weight: random.random_range(0.4..1.6),
        session: MEAN_SESSION
            * match scenario.sessions {
                Sessions::Exponential => exponential(random),
                Sessions::Heavy => bounded_pareto(random),
            },
    }
}

/// Exponential with mean 1.
fn exponential(random: &mut StdRng) -> f64 {
    -(1.0 - random.random::<f64>()).ln()
}

/// Pareto with alpha 1.5, bounded at 100 times the least value, with mean 1.
fn bounded_pareto(random: &mut StdRng) -> f64 {
    let alpha = 1.5;
    let span = 100.0_f64;
    let tail = span.powf(-alpha);
    // The mean of the distribution whose least value is 1.
    let mean = alpha / (alpha - 1.0) * (1.0 - span.powf(1.0 - alpha)) / (1.0 - tail);
    (1.0 - random.random::<f64>() * (1.0 - tail)).powf(-1.0 / alpha) / mean
}
