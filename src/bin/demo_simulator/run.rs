//! A run of the simulator, from the open port to the exit code.

use std::future::Future;
use std::net::TcpListener;
use std::time::Duration;

use actix::{Actor as _, Addr, Recipient, System};
use actix_web::dev::Server;
use actix_web::{App, HttpServer, rt, web};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;

use crate::args::Options;
use crate::client::Event;
use crate::console::{self, Console};
use crate::files::{self, ProjectFolder};
use crate::port;
use crate::simulation::{CloseAll, Simulation};
use crate::world::WorldFile;

/// Connections at a time; more wait.
const MOST_CONNECTIONS: usize = 256;
/// How long clients have to say goodbye, in seconds.
const GOODBYE_SECS: u64 = 1;

/// Runs a simulation until it is told to end, then exits without waiting for the threads: one of them may
/// be stuck with reading the world.
pub(crate) fn run(options: &Options) -> ! {
    let system = System::new();
    let code = system.block_on(simulate(options)).unwrap_or_else(|error| {
        console::fatal(error);
        1
    });
    std::process::exit(code);
}

async fn simulate(options: &Options) -> Result<i32, Box<dyn std::error::Error>> {
    let console = Console { stdout: options.stdout, stderr: options.stderr };
    let told_to_end = signals()?;
    let listener = port::listen(options.port, console)?;
    warn_of(options, console);
    if let Some(period) = options.heartbeat {
        rt::spawn(beat(period));
    }

    let file = WorldFile::new(&options.world);
    let project = ProjectFolder::new(file.project());
    let (failed, failure) = oneshot::channel();
    let simulation = Simulation::new(file, options.mode, options.stream, console, failed).start();
    let server = serve(listener, simulation.clone().recipient(), project)?;
    let handle = server.handle();
    rt::spawn(server);

    tokio::select! {
        () = told_to_end => end(&simulation, &handle).await,
        Ok(error) = failure => return Err(error.into()),
    }
    Ok(0)
}

async fn end(simulation: &Addr<Simulation>, server: &actix_web::dev::ServerHandle) {
    if simulation.send(CloseAll).await.is_ok() {
        let goodbye = Duration::from_secs(2 * GOODBYE_SECS);
        drop(tokio::time::timeout(goodbye, server.stop(true)).await);
    }
}

/// Ends with the first signal that asks the program to end.
fn signals() -> std::io::Result<impl Future<Output = ()>> {
    let [mut terminate, mut interrupt, mut hang_up, mut quit]: [Signal; 4] = [
        signal(SignalKind::terminate())?,
        signal(SignalKind::interrupt())?,
        signal(SignalKind::hangup())?,
        signal(SignalKind::quit())?,
    ];
    Ok(async move {
        tokio::select! {
            _ = terminate.recv() => (),
            _ = interrupt.recv() => (),
            _ = hang_up.recv() => (),
            _ = quit.recv() => (),
        }
    })
}

fn warn_of(options: &Options, console: Console) {
    if options.stream && !options.batch {
        console.warning("Streaming should be used with --batch.");
    }
    if options.deprecated_mode {
        console::explain("The modes 'stop' and 'run' are deprecated: use 'pause' and 'fast'.");
    }
}

/// The first beat comes one period after the start, as with Webots.
async fn beat(period: Duration) {
    let mut beats = tokio::time::interval(period);
    beats.tick().await;
    loop {
        beats.tick().await;
        console::status(".");
    }
}

fn serve(listener: TcpListener, simulation: Recipient<Event>, project: ProjectFolder) -> std::io::Result<Server> {
    let simulation = web::Data::new(simulation);
    let project = web::Data::new(project);
    let server = HttpServer::new(move || {
        App::new().app_data(simulation.clone()).app_data(project.clone()).configure(files::configure)
    });
    Ok(server
        .on_connect(files::remember_connection)
        .workers(1)
        .worker_max_blocking_threads(2)
        .max_connections(MOST_CONNECTIONS)
        .shutdown_timeout(GOODBYE_SECS)
        .disable_signals()
        .listen(listener)?
        .run())
}
