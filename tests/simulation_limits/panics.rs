//! Panics of actors: their resources are freed, and a server that can't go on ends.

use std::net::TcpListener;
use std::sync::Arc;

use actix::prelude::*;
use actix_web::{App, HttpRequest, HttpResponse, HttpServer, web};
use actix_web_actors::ws::WsResponseBuilder;
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};
use webots_fleet::shared::domain::Stage;
use webots_fleet::shared::http::ConnectionKind;
use webots_fleet::simulation::attachment::{Connection, ToClient};
use webots_fleet::simulation::client::{Session, WebClient};
use webots_fleet::simulation::client_identity::ClientIdentity;
use webots_fleet::simulation::machine::LoadMonitor;
use webots_fleet::simulation::protocol::Start;
use webots_fleet::simulation::state::AppState;

use crate::inside::Inside;
use crate::support::{Client, arm};

/// An actor that receives this panics.
#[derive(Message)]
#[rtype(result = "()")]
struct Panic;

/// Lets these actors receive [`Panic`].
macro_rules! panics {
    ($($actor:ty),*) => {
        $(impl Handler<Panic> for $actor {
            type Result = ();

            fn handle(&mut self, _: Panic, _: &mut Self::Context) {
                // Panics without printing.
                std::panic::resume_unwind(Box::new("a test has asked for it"));
            }
        })*
    };
}

panics!(WebClient, Session, LoadMonitor);

/// Opens a WebSocket as the server does, and sends the address of its actor to the test.
async fn gate(
    request: HttpRequest,
    stream: web::Payload,
    server: web::Data<AppState>,
    clients: web::Data<UnboundedSender<Addr<WebClient>>>,
) -> HttpResponse {
    let peer = server.config.trusted_proxies.peer(&request);
    let connection = server.connections.admit(ConnectionKind::Client, peer).unwrap();
    let client = WebClient::new(Arc::clone(&server), (peer, None), connection);
    let (address, response) = WsResponseBuilder::new(client, &request, stream)
        .start_with_addr()
        .unwrap();
    clients.send(address).unwrap();
    response
}

pub async fn a_client_leaves_nothing_in_any_state() {
    let stages = [
        Stage::Queued,
        Stage::CheckingOut,
        Stage::Launching,
        Stage::Idle,
        Stage::Running,
    ];
    for stage in std::iter::once(None).chain(stages.map(Some)) {
        let inside = Inside::new(stage.unwrap_or(Stage::Idle), |_| ()).await;
        let (sender, mut clients) = unbounded_channel::<Addr<WebClient>>();
        let server = web::Data::from(Arc::clone(&inside.server));
        let socket = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        let app = move || {
            App::new()
                .app_data(server.clone())
                .app_data(web::Data::new(sender.clone()))
                .route("/client", web::get().to(gate))
        };
        let door = HttpServer::new(app)
            .workers(1)
            .disable_signals()
            .shutdown_timeout(1)
            .listen(socket)
            .unwrap()
            .run();
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
            client = client.asking(&arm()).await;
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

/// Stands for the connection of a client, and ignores what is sent to it.
struct Ignored;

impl Actor for Ignored {
    type Context = Context<Self>;
}

impl Handler<ToClient> for Ignored {
    type Result = ();

    fn handle(&mut self, _: ToClient, _: &mut Self::Context) {}
}

pub async fn a_session_leaves_nothing_in_any_state() {
    for stage in [
        Stage::Queued,
        Stage::CheckingOut,
        Stage::Launching,
        Stage::Idle,
        Stage::Running,
    ] {
        let inside = Inside::new(stage, |_| ()).await;
        let mut first = None;
        if stage == Stage::Queued {
            first = Some(inside.client().await);
            inside.until(Stage::Idle).await;
        }
        let (actions, receiver) = unbounded_channel();
        let connection = Connection {
            peer: inside
                .server
                .config
                .trusted_proxies
                .of_connection([127, 0, 0, 1].into()),
            client: Ignored.start().recipient(),
            actions: receiver,
        };
        let start = Start {
            url: arm(),
            mode: None,
            resumable: Some(true),
            early: None,
            name: None,
            pass: None,
        };
        let identity = ClientIdentity::new(None, None);
        let session = Session::open(&inside.server, identity, connection, &start).unwrap();
        inside.until(stage).await;
        session.do_send(Panic);
        // By this a client's connection notices that its session is gone.
        actix_rt::time::timeout(crate::support::SOON, actions.closed())
            .await
            .unwrap();
        if let Some(first) = first {
            crate::support::until("the line is empty", async || inside.stages() == [Stage::Idle]).await;
            first.leave().await;
        }
        inside.until_nothing_is_left().await;
        inside.stop().await;
    }
}

/// The configuration allows no such time; the actor panics when it computes the end of the pause.
pub async fn a_webots_leaves_nothing_and_its_client_is_told() {
    let inside = Inside::new(Stage::Idle, |config| config.idle_timeout = 1e300).await;
    let mut client = inside.client().await;
    assert_eq!(client.closed().await, Some(1011));
    assert_eq!(client.reason()["code"], "lost");
    inside.until_nothing_is_left().await;
    inside.stop().await;
}

pub async fn an_actor_that_must_live_ends_the_server() {
    let inside = Inside::new(Stage::Idle, |_| ()).await;
    inside.server.load_monitor.do_send(Panic);
    // Any error here makes the program end with exit code 1.
    assert_eq!(
        inside.ended().await.unwrap_err().to_string(),
        "the actor LoadMonitor is gone"
    );
}
