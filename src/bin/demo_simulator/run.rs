//! A run of the simulator, from the open port to the exit code.

use std::error::Error;
use std::rc::Rc;
use std::time::Duration;

use actix::{Actor as _, System};
use actix_web::rt;
use futures_util::future::select_all;
use tokio::net::TcpListener;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tokio::time::{self, MissedTickBehavior};

use crate::args::Args;
use crate::console::{self, Console};
use crate::http;
use crate::port;
use crate::simulation::{CloseClients, Simulation};
use crate::world::WorldFile;

/// Timeout of the closing handshake with clients.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Runs a simulation until a signal ends it, and returns the exit code.
pub(crate) fn run(args: &Args) -> i32 {
    match System::new().block_on(simulate(args)) {
        Ok(()) => 0,
        Err(error) => {
            console::fatal(error);
            1
        }
    }
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
    listener.set_nonblocking(true)?;
    if args.stream.is_some() && !args.batch {
        console.trouble("WARNING: Streaming should be used with --batch.");
    }
    if let Some(period) = args.heartbeat {
        rt::spawn(beat(Duration::from_millis(period)));
    }

    let file = WorldFile::new(args.world.as_deref().unwrap_or("".as_ref()));
    let project = Rc::from(file.project());
    let (report_failure, failure) = oneshot::channel();
    let simulation = Simulation::new(file, args.mode, args.stream.is_some(), console, report_failure).start();
    rt::spawn(http::serve(
        TcpListener::from_std(listener)?,
        simulation.clone(),
        project,
    ));

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

/// The first heartbeat comes one period after the start, as with Webots. Those that a busy thread misses are left out.
async fn beat(period: Duration) {
    let mut beats = time::interval(period);
    beats.set_missed_tick_behavior(MissedTickBehavior::Delay);
    beats.tick().await;
    loop {
        beats.tick().await;
        console::status(".");
    }
}
