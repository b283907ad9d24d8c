//! Panics of actors: what they held is freed, and a server that can't go on ends.

use std::net::TcpListener;
use std::sync::Arc;

use actix::prelude::*;
use actix_web::{App, HttpRequest, HttpResponse, HttpServer, web};
use actix_web_actors::ws::WsResponseBuilder;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use webots_fleet::shared::domain::ProjectUrl;
use webots_fleet::shared::http::{ConnectionKind, Peer};
use webots_fleet::simulation::client::WebClient;
use webots_fleet::simulation::client_identity::ClientIdentity;
use webots_fleet::simulation::ends::EndReason;
use webots_fleet::simulation::machine::LoadMonitor;
use webots_fleet::simulation::protocol::Mode;
use webots_fleet::simulation::readiness;
use webots_fleet::simulation::simulation_id::SimulationId;
use webots_fleet::simulation::slots::{Slot, SlotEvent, SlotLease};
use webots_fleet::simulation::snapshot::Stage;
use webots_fleet::simulation::state::AppState;
use webots_fleet::simulation::webots::{LaunchSpec, Stop, Webots, WebotsEvent, WebotsExit};

use crate::inside::{Inside, ask};
use crate::support::{Client, SOON, arm};

/// Whoever gets this panics.
#[derive(Message)]
#[rtype(result = "()")]
struct Panic;

/// Lets actors get it.
macro_rules! panics {
    ($($actor:ty),*) => {
        $(impl Handler<Panic> for $actor {
            type Result = ();

            fn handle(&mut self, _: Panic, _: &mut Self::Context) {
                // A panic that prints nothing.
                std::panic::resume_unwind(Box::new("a test has asked for it"));
            }
        })*
    };
}

panics!(WebClient, Webots, LoadMonitor);

/// Opens a WebSocket as the server does, and gives away its actor's address.
async fn gate(
    request: HttpRequest,
    stream: web::Payload,
    server: web::Data<AppState>,
    clients: web::Data<UnboundedSender<Addr<WebClient>>>,
) -> HttpResponse {
    let peer = server.config.trusted_proxies.peer(&request);
    let connection = server.connections.admit(ConnectionKind::Client, peer).unwrap();
    let client = WebClient::new(Arc::clone(&server), (peer, None), connection);
    let (address, response) = WsResponseBuilder::new(client, &request, stream).start_with_addr().unwrap();
    clients.send(address).unwrap();
    response
}

pub async fn a_client_leaves_nothing_in_any_state() {
    let stages = [Stage::Queued, Stage::CheckingOut, Stage::Launching, Stage::Idle, Stage::Running];
    for stage in std::iter::once(None).chain(stages.map(Some)) {
        let inside = Inside::new(stage.unwrap_or(Stage::Idle), |_| ()).await;
        let (sender, mut clients) = unbounded_channel::<Addr<WebClient>>();
        let (server, socket) = (web::Data::from(Arc::clone(&inside.server)), TcpListener::bind("127.0.0.1:0").unwrap());
        let port = socket.local_addr().unwrap().port();
        let app = move || {
            App::new()
                .app_data(server.clone())
                .app_data(web::Data::new(sender.clone()))
                .route("/client", web::get().to(gate))
        };
        let door = HttpServer::new(app).workers(1).disable_signals().shutdown_timeout(1).listen(socket).unwrap().run();
        let handle = door.handle();
        actix_rt::spawn(door);
        let mut first = None;
        if stage == Some(Stage::Queued) {
            first = Some(inside.client().await);
            inside.until(Stage::Idle).await;
        }
        let mut client = Client::connect(&format!("ws://127.0.0.1:{port}/client")).await;
        let address = clients.recv().await.unwrap();
        if let Some(stage) = stage {
            ask(&mut client).await;
            inside.until(stage).await;
        }
        address.do_send(Panic);
        client.closed().await;
        assert!(!address.connected(), "{stage:?}: it lives on");
        if let Some(first) = first {
            crate::support::until("the line is empty", async || inside.stages() == [Stage::Idle]).await;
            first.leave().await;
        }
        inside.until_nothing_is_left().await;
        handle.stop(true).await;
        inside.stop().await;
    }
}

/// Hears what a web client would.
struct Listener {
    places: UnboundedSender<u16>,
    exits: UnboundedSender<WebotsExit>,
}

impl Actor for Listener {
    type Context = Context<Self>;
}

impl Handler<SlotEvent> for Listener {
    type Result = ();

    fn handle(&mut self, event: SlotEvent, _: &mut Self::Context) {
        if let SlotEvent::Granted(port) = event {
            self.places.send(port).unwrap();
        }
    }
}

impl Handler<WebotsEvent> for Listener {
    type Result = ();

    fn handle(&mut self, event: WebotsEvent, _: &mut Self::Context) {
        if let WebotsEvent::Exited(exit) = event {
            self.exits.send(exit).unwrap();
        }
    }
}

/// Asks for a place as a session does.
fn lease(server: &AppState, listener: &Addr<Listener>, world: &ProjectUrl) -> SlotLease {
    let client = (Peer::Unknown, ClientIdentity::default());
    SlotLease::acquire(&server.slots, SimulationId::next(), listener.clone().recipient(), world, client).unwrap()
}

/// Starts a Webots as a web client does.
async fn launch(server: &AppState) -> (Addr<Webots>, UnboundedReceiver<WebotsExit>) {
    let (places, mut granted) = unbounded_channel();
    let (exits, ended) = unbounded_channel();
    let listener = Listener { places, exits }.start();
    let world = ProjectUrl::parse(&arm()).unwrap();
    let lease = lease(server, &listener, &world);
    let port = granted.recv().await.unwrap();
    let project = server.checkouts.start(world, server.run.instance().unwrap(), |_| ()).await.unwrap().unwrap();
    let spec = LaunchSpec {
        config: Arc::clone(&server.config),
        containers: None,
        launcher: Arc::clone(&server.launcher),
        watcher: server.watcher.clone(),
        program: readiness::webots_program(&server.config).unwrap(),
        project: Arc::new(project),
        mode: Mode::X3d,
        slot: Slot { lease, port },
        gpu: None,
        events: listener.recipient(),
    };
    (Webots::new(spec).start(), ended)
}

pub async fn a_webots_leaves_nothing_in_any_state() {
    for stage in [Stage::Launching, Stage::Idle, Stage::Running, Stage::Stopping] {
        let inside = Inside::new(stage, |_| ()).await;
        let (webots, mut ended) = launch(&inside.server).await;
        if stage == Stage::Stopping {
            inside.until(Stage::Idle).await;
            webots.do_send(Stop(EndReason::Left));
        }
        inside.until(stage).await;
        let begin = std::time::Instant::now();
        webots.do_send(Panic);
        let exit = actix_rt::time::timeout(SOON, ended.recv()).await.unwrap().unwrap();
        assert!(!exit.clean && !exit.why.is_empty(), "{stage:?}: {exit:?}");
        inside.until_nothing_is_left().await;
        assert!(begin.elapsed().as_secs() < 4, "{stage:?}: the grace time was waited for, in which all may go wrong");
        assert_eq!(inside.server.ends.latest()[0].how.reason, EndReason::Fault, "{stage:?}");
        inside.stop().await;
    }
}

pub async fn an_actor_that_must_live_ends_the_server() {
    let inside = Inside::new(Stage::Idle, |_| ()).await;
    inside.server.load_monitor.do_send(Panic);
    // The program ends with exit code 1 for whatever is told here.
    assert_eq!(inside.ended().await.unwrap_err().to_string(), "the actor LoadMonitor is gone");
}

pub async fn slots_in_disorder_end_the_server() {
    let inside = Inside::new(Stage::Idle, |_| ()).await;
    let (places, _granted) = unbounded_channel();
    let listener = Listener { places, exits: unbounded_channel().0 }.start();
    let lease = lease(&inside.server, &listener, &ProjectUrl::parse(&arm()).unwrap());
    let panic = || lease.update(|_| std::panic::resume_unwind(Box::new("a test has asked for it")));
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(panic)).unwrap_err();
    assert_eq!(inside.ended().await.unwrap_err().to_string(), "a panic has left the slots in disorder");
}
