//! A baseline of actix without a session server: a handler that only answers, and an actor per WebSocket that only
//! waits. It runs as a child process, like the session server.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use actix_web::{App, Error, HttpRequest, HttpResponse, HttpServer, web};
use actix_web_actors::ws::{self, Message, ProtocolError, WebsocketContext};

/// The argument that makes this program the bare server.
pub(crate) const ARGUMENT: &str = "bare-server";

/// The running server, killed on drop.
pub(crate) struct Bare {
    child: Child,
    pub(crate) port: u16,
}

impl Bare {
    pub(crate) fn start() -> Self {
        let this = std::env::current_exe().expect("the path of this program");
        let mut child = Command::new(this)
            .arg(ARGUMENT)
            .stdout(Stdio::piped())
            .spawn()
            .expect("this program starts");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("its output"))
            .read_line(&mut line)
            .expect("its port");
        Self {
            port: line.trim().parse().expect("its port"),
            child,
        }
    }

    pub(crate) fn process(&self) -> u32 {
        self.child.id()
    }
}

impl Drop for Bare {
    fn drop(&mut self) {
        self.child.kill().expect("the server can be killed");
        self.child.wait().expect("the server has ended");
    }
}

struct Idle;

impl actix::Actor for Idle {
    type Context = WebsocketContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.text("1");
    }
}

impl actix::StreamHandler<Result<Message, ProtocolError>> for Idle {
    fn handle(&mut self, _: Result<Message, ProtocolError>, _: &mut Self::Context) {}
}

async fn idle(request: HttpRequest, stream: web::Payload) -> Result<HttpResponse, Error> {
    ws::start(Idle, &request, stream)
}

/// Prints its port, and serves until it is killed.
pub(crate) fn serve() -> std::io::Result<()> {
    actix_web::rt::System::new().block_on(async {
        let answer = || async { "ws://localhost:2000" };
        let app = move || {
            App::new()
                .route("/bare", web::get().to(answer))
                .route("/session", web::get().to(idle))
        };
        let server = HttpServer::new(app).bind(("127.0.0.1", 0))?;
        println!("{}", server.addrs().first().map_or(0, std::net::SocketAddr::port));
        server.run().await
    })
}
