//! One client: the steps of Webots' web page from the request of a simulation to its end.

use std::cell::RefCell;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::arguments::Arguments;
use crate::behaviour::Behaviour;
use crate::board::{Board, Stage};
use crate::connection::{Connection, Ended, simulated_time, unless_error};
use crate::paces::Paces;
use crate::returning::WayBack;
use crate::session_server::{NoServer, SessionServer};
use crate::visit::{Outcome, Pace, Steps, Visit};
use crate::words::line;

/// Duration of the measurement of one value of the pace.
const PACE_PERIOD: Duration = Duration::from_secs(1);
/// Pause before the next check of the availability after other clients were faster: the first one, and the longest one.
/// It doubles each time.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(8);

/// A client and its state.
pub(crate) struct Browser<'class> {
    arguments: &'class Arguments,
    board: &'class Board,
    session_server: &'class SessionServer,
    behaviour: Behaviour,
    stay: Duration,
    visit: Visit,
    /// Receives the visit at its end.
    visits: &'class RefCell<Vec<Visit>>,
    paces: &'class Paces,
    /// The session server's last message that no slot was available, although one was just before.
    full: Option<String>,
}

/// A running simulation: the connection that owns it, and the one to its Webots.
struct Running {
    lease: Connection,
    stream: Connection,
    /// For a client that returns.
    way_back: Option<WayBack>,
}

/// A request for a simulation. What is absent, the original does not know.
#[derive(Serialize)]
struct Start<'world> {
    url: &'world str,
    #[serde(skip_serializing_if = "Option::is_none")]
    resumable: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pass: Option<String>,
}

/// Why a start failed.
enum StartError {
    Refused(String),
    Failed(String),
    Left,
}

impl From<Ended> for StartError {
    fn from(ended: Ended) -> Self {
        Self::Failed(ended.to_string())
    }
}

impl<'class> Browser<'class> {
    /// A client that requests a simulation now. Its paces are added to `paces`; its visit to `visits` on drop, even if that
    /// interrupts the visit.
    pub(crate) fn new(
        arguments: &'class Arguments,
        board: &'class Board,
        session_server: &'class SessionServer,
        (visits, paces): (&'class RefCell<Vec<Visit>>, &'class Paces),
        (client, behaviour, stay): (u32, Behaviour, Duration),
    ) -> Self {
        let asked = board.now();
        let visit = Visit {
            client,
            behaviour,
            asked,
            server: None,
            place: None,
            turn: None,
            outcome: Outcome::Left,
            steps: Steps::default(),
            pace: Vec::new(),
            ended: asked,
        };
        Self {
            arguments,
            board,
            session_server,
            behaviour,
            stay,
            visit,
            visits,
            paces,
            full: None,
        }
    }

    /// Goes through all steps. `meet` receives the simulation server of the client.
    pub(crate) async fn visit(mut self, meet: impl Fn(&str)) {
        self.board.came();
        let patience = self.arguments.patience;
        let started = actix_rt::time::timeout(patience, self.start(meet)).await;
        let started = started.unwrap_or_else(|_| {
            let why = self.full.as_ref().map(|full| format!(": {full}")).unwrap_or_default();
            Err(StartError::Failed(format!(
                "no simulation within {}{why}",
                humantime::format_duration(patience)
            )))
        });
        self.visit.outcome = match started {
            Ok(running) => {
                // The outcome if the visit is interrupted.
                self.visit.outcome = Outcome::Unseen;
                let _stage = self.board.enter(Stage::Running);
                self.watch(running).await
            }
            Err(StartError::Refused(why)) => Outcome::Refused(why),
            Err(StartError::Failed(why)) => Outcome::Failed(why),
            Err(StartError::Left) => Outcome::Left,
        };
        self.board.gone(matches!(
            self.visit.outcome,
            Outcome::Ran | Outcome::Unseen | Outcome::Left
        ));
    }

    async fn start(&mut self, meet: impl Fn(&str)) -> Result<Running, StartError> {
        let waiting = self.board.enter(Stage::Waiting);
        let asked = Instant::now();
        let (server, pass) = if self.arguments.line {
            self.wait_in_line().await?
        } else {
            (self.find_server().await?, None)
        };
        meet(&server);
        self.visit.server = server.split_once("://").map(|(_, address)| address.to_owned());
        let mut lease = Connection::open(&format!("{server}/client")).await?;
        let start = Start {
            url: &self.arguments.world,
            resumable: (self.behaviour == Behaviour::Return).then_some(true),
            pass,
        };
        lease.say(&serde_json::json!({ "start": start }).to_string()).await?;
        if self.behaviour == Behaviour::Hasty {
            lease.close().await;
            return Err(StartError::Left);
        }
        let mut first = self.hear_of_start(&mut lease).await?;
        while is_before_slot(&first) {
            first = self.hear_of_start(&mut lease).await?;
        }
        drop(waiting);
        let _starting = self.board.enter(Stage::Starting);
        let granted = Instant::now();
        self.visit.turn.get_or_insert(self.board.now());
        self.visit.steps.waiting = Some((granted - asked).as_secs_f64());
        let mut launched = None;
        let mut text = first;
        let webots = loop {
            if text.starts_with("shutdownTimeout:") && launched.is_none() {
                launched = Some(Instant::now());
            }
            if let Some(url) = text.strip_prefix("webots:") {
                break url.to_owned();
            }
            text = self.hear_of_start(&mut lease).await?;
        };
        let launched = launched.unwrap_or(granted);
        self.visit.steps.checkout = Some((launched - granted).as_secs_f64());
        let stream = self.open_stream(&webots).await?;
        self.visit.steps.launch = Some(launched.elapsed().as_secs_f64());
        self.visit.steps.until_running = Some(asked.elapsed().as_secs_f64());
        let way_back = match self.behaviour {
            Behaviour::Return => Some(Box::pin(WayBack::find(&mut lease, &server, &webots)).await?),
            _ => None,
        };
        Ok(Running {
            lease,
            stream,
            way_back,
        })
    }

    /// Waits in the line for a simulation server. Returns its URL and the pass for it, if there is one.
    async fn wait_in_line(&mut self) -> Result<(String, Option<String>), StartError> {
        self.full.get_or_insert_with(|| "it waited in the line".to_owned());
        let first = &mut self.visit.place;
        let place = |ahead| {
            first.get_or_insert(ahead);
        };
        let turn = self.session_server.turn(&self.arguments.world, place).await;
        let (server, pass) = turn.map_err(StartError::Refused)?;
        self.full = None;
        if pass.is_some() {
            self.visit.turn = Some(self.board.now());
        }
        Ok((server, pass))
    }

    /// Waits until the fleet is available and requests a simulation server; retries if other clients were faster.
    async fn find_server(&mut self) -> Result<String, StartError> {
        let mut pause = FIRST_PAUSE;
        loop {
            self.full
                .get_or_insert_with(|| "no simulation server was available".to_owned());
            self.session_server.until_available().await?;
            match self.session_server.simulation_server(&self.arguments.world).await {
                Ok(server) => {
                    self.full = None;
                    return Ok(server);
                }
                Err(NoServer { answer, is_full: true }) => self.full = Some(answer),
                Err(NoServer { answer, .. }) => return Err(StartError::Refused(answer)),
            }
            // Clients that wait together must not retry together.
            actix_rt::time::sleep(pause.mul_f64(rand::random_range(0.5..1.0))).await;
            pause = (pause * 2).min(LONGEST_PAUSE);
        }
    }

    /// The next text of the simulation server; an error with any of the prefixes is a refusal.
    async fn hear_of_start(&self, lease: &mut Connection) -> Result<String, StartError> {
        let text = lease.receive().await?;
        let refusal = ["loading: Error: ", "error:", "Error: "]
            .iter()
            .find_map(|begin| text.strip_prefix(begin));
        match refusal {
            Some(why) => Err(StartError::Refused(why.trim().to_owned())),
            None => Ok(text),
        }
    }

    /// Connects to Webots as its viewer does, waits for the scene, and starts the simulation.
    async fn open_stream(&self, url: &str) -> Result<Connection, StartError> {
        let mut stream = Connection::open_scene(&format!("{}/", url.trim_end_matches('/'))).await?;
        stream.say(&self.arguments.viewer).await?;
        while !unless_error(stream.receive().await?)?.starts_with("model:") {}
        stream.say("pause").await?;
        while unless_error(stream.receive().await?)? != "paused by client" {}
        stream.say("real-time:-1").await?;
        let mut first = None;
        loop {
            let time = simulated_time(&unless_error(stream.receive().await?)?);
            match (first, time) {
                (Some(first), Some(time)) if time > first => return Ok(stream),
                (None, Some(time)) => first = Some(time),
                _ => {}
            }
        }
    }

    /// Watches a simulation until its client leaves.
    async fn watch(&mut self, mut running: Running) -> Outcome {
        let stay = self.stay;
        let attentive = match self.behaviour {
            Behaviour::Ordinary | Behaviour::Drop | Behaviour::Hasty => stay,
            Behaviour::Reload | Behaviour::Return | Behaviour::Sleep | Behaviour::Vanish => stay / 2,
        };
        let watched = actix_rt::time::timeout(attentive, self.look_on(&mut running)).await;
        if let Ok(why) = watched {
            return Outcome::BrokeOff(why);
        }
        if let Some(way_back) = running.way_back.take() {
            // The page is reloaded: both connections are dropped.
            drop(running);
            running = match Box::pin(way_back.go(&self.arguments.viewer)).await {
                Ok((lease, stream)) => Running {
                    lease,
                    stream,
                    way_back: None,
                },
                Err(ended) => return Outcome::BrokeOff(format!("coming back: {ended}")),
            };
            let watched = Box::pin(actix_rt::time::timeout(stay / 2, self.look_on(&mut running)));
            if let Ok(why) = watched.await {
                return Outcome::BrokeOff(why);
            }
        } else if attentive < stay && self.behaviour != Behaviour::Reload {
            actix_rt::time::sleep(stay.saturating_sub(attentive)).await;
        }
        if matches!(
            self.behaviour,
            Behaviour::Ordinary | Behaviour::Reload | Behaviour::Return | Behaviour::Sleep
        ) {
            // The page closes both at once.
            futures_util::future::join(running.stream.close(), running.lease.close()).await;
        }
        // Clients that vanish or crash drop the connections without closing them.
        match self.behaviour {
            // Its simulation may have ended long before.
            Behaviour::Sleep | Behaviour::Vanish => Outcome::Unseen,
            _ => Outcome::Ran,
        }
    }

    /// Reads all messages and measures the pace, until the simulation ends. Returns why it ended.
    async fn look_on(&mut self, running: &mut Running) -> String {
        let mut since = Instant::now();
        let mut first = None;
        let mut last = None;
        let mut period = actix_rt::time::interval(PACE_PERIOD);
        loop {
            tokio::select! {
                // Messages that have arrived are read before the second ends, even if this program was delayed.
                biased;
                text = running.stream.receive() => match text {
                    Ok(text) => if let Some(time) = simulated_time(&text) {
                        first.get_or_insert(time);
                        last = Some(time);
                    },
                    Err(ended) => return format!("the connection to Webots: {ended}"),
                },
                text = running.lease.receive() => match text {
                    Ok(text) => if let Some(why) = text.strip_prefix("loading: ") {
                        return why.to_owned();
                    },
                    Err(ended) => return format!("the connection to the simulation server: {ended}"),
                },
                _ = period.tick() => {
                    let wall = since.elapsed().as_secs_f64();
                    if wall < PACE_PERIOD.as_secs_f64() / 2.0 {
                        continue;
                    }
                    // A paused simulation sends nothing.
                    let simulated = first.zip(last).map_or(0.0, |(first, last): (f64, f64)| last - first) / 1000.0;
                    let factor = simulated / wall;
                    self.visit.pace.push(Pace { at: self.board.now(), factor });
                    self.paces.add(&self.visit);
                    (since, first) = (Instant::now(), last);
                }
            }
        }
    }
}

impl Drop for Browser<'_> {
    fn drop(&mut self) {
        self.visit.ended = self.board.now();
        self.paces.remove(self.visit.client);
        if let Outcome::BrokeOff(why) | Outcome::Refused(why) | Outcome::Failed(why) = &mut self.visit.outcome {
            *why = line(why);
        }
        self.visits.borrow_mut().push(self.visit.clone());
    }
}

/// Whether a text says that no slot is free yet, or comes before that is known.
fn is_before_slot(text: &str) -> bool {
    let before = ["session:", "absence:", "resume:", "queue:"];
    before.iter().any(|begin| text.starts_with(begin))
        || text.to_ascii_lowercase().starts_with("loading: waiting for a place")
}
