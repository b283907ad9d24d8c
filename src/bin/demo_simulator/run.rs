//! A run of the simulator, from the open port to the exit code.

use std::error::Error;
use std::net::TcpListener;
use std::sync::mpsc;
use std::time::Duration;
use std::{future, io, thread};

use actix::{Actor as _, Recipient, System};
use actix_web::dev::Server;
use actix_web::{App, HttpServer, rt, web};
use futures_util::future::select_all;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tokio::time;

use crate::args::Args;
use crate::client::Event;
use crate::console::{self, Console};
use crate::http::{self, ProjectFolder};
use crate::port;
use crate::simulation::{CloseClients, Simulation};
use crate::world::WorldFile;

/// Limit of connections; more wait.
const MAX_CONNECTIONS: usize = 256;
/// Timeout of the closing handshake with clients.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Runs a simulation until a signal ends it, and returns the exit code.
///
/// The process must then exit without waiting for any thread: one may still be reading the world. No thread with actors
/// ends before that, because actix's thread-local values panic if they are dropped on two threads at once.
pub(crate) fn run(args: Args) -> i32 {
    let (sender, code) = mpsc::channel();
    let thread = thread::Builder::new().spawn(move || {
        System::new().block_on(async {
            let code = simulate(&args).await.map_or_else(fail, |()| 0);
            sender.send(code).ok();
            future::pending::<()>().await;
        });
    });
    if let Err(error) = thread {
        return fail(format!("no thread can be started: {error}").into());
    }
    code.recv().unwrap_or(1)
}

fn fail(error: Box<dyn Error>) -> i32 {
    console::fatal(error);
    1
}

async fn simulate(args: &Args) -> Result<(), Box<dyn Error>> {
    let console = Console {
        stdout: args.stdout,
        stderr: args.stderr,
    };
    let kinds = [
        SignalKind::terminate(),
        SignalKind::interrupt(),
        SignalKind::hangup(),
        SignalKind::quit(),
    ];
    let signals = kinds.into_iter().map(signal).collect::<Result<_, _>>()?;
    let listener = port::listen(args.port, console)?;
    if args.stream.is_some() && !args.batch {
        console.warning("Streaming should be used with --batch.");
    }
    if let Some(period) = args.heartbeat {
        rt::spawn(beat(Duration::from_millis(period)));
    }

    let file = WorldFile::new(args.world.as_deref().unwrap_or("".as_ref()));
    let project = ProjectFolder::new(file.project());
    let (report_failure, failure) = oneshot::channel();
    let simulation = Simulation::new(file, args.mode, args.stream.is_some(), console, report_failure).start();
    rt::spawn(serve(listener, simulation.clone().recipient(), project)?);

    tokio::select! {
        () = first_of(signals) => drop(time::timeout(CLOSE_TIMEOUT, simulation.send(CloseClients)).await),
        Ok(error) = failure => return Err(error.into()),
    }
    Ok(())
}

/// Completes at the first signal that ends the program.
async fn first_of(mut signals: Vec<Signal>) {
    select_all(signals.iter_mut().map(|signal| Box::pin(signal.recv()))).await;
}

/// The first heartbeat comes one period after the start, as with Webots.
async fn beat(period: Duration) {
    let mut beats = time::interval(period);
    beats.tick().await;
    loop {
        beats.tick().await;
        console::status(".");
    }
}

fn serve(listener: TcpListener, simulation: Recipient<Event>, project: ProjectFolder) -> io::Result<Server> {
    let simulation = web::Data::new(simulation);
    let project = web::Data::new(project);
    let server = HttpServer::new(move || {
        App::new()
            .app_data(simulation.clone())
            .app_data(project.clone())
            .configure(http::configure)
    });
    Ok(server
        .workers(1)
        .worker_max_blocking_threads(2)
        .max_connections(MAX_CONNECTIONS)
        .disable_signals()
        .listen(listener)?
        .run())
}
