//! How a session waits for the first viewer of its simulation, and ends the simulation if none comes.
//!
//! A page may be left while its connection stays open. The relay reports a viewer; without it, viewers connect to the port
//! of Webots, and the kernel is asked once, at the end of the wait.

use actix::prelude::*;
use actix_rt::task::spawn_blocking;

use super::session::{Arrival, Client, ReadySimulation, Session, State};
use crate::simulation::ends::StopReason;
use crate::simulation::process::process_tree::has_connection;

impl Session {
    /// Starts the wait for the first viewer, unless it may take any time.
    pub(super) fn await_viewer(&self, ctx: &mut Context<Self>) -> Arrival {
        let limit = self.server.config.timing.arrival;
        if limit.is_zero() {
            return Arrival::Settled;
        }
        Arrival::Awaited(ctx.run_later(limit, Self::check_arrival))
    }

    /// Starts the wait anew for a client that has come back.
    pub(super) fn await_viewer_again(&mut self, ctx: &mut Context<Self>) {
        if let Some(timer) = self.awaited() {
            ctx.cancel_future(timer);
            let arrival = self.await_viewer(ctx);
            self.set_arrival(arrival);
        }
    }

    /// Ends the wait: a viewer is there.
    pub(super) fn settle_arrival(&mut self, ctx: &mut Context<Self>) {
        if let Some(timer) = self.awaited() {
            ctx.cancel_future(timer);
            self.set_arrival(Arrival::Settled);
        }
    }

    /// The timer of the wait, if it waits.
    fn awaited(&self) -> Option<SpawnHandle> {
        match self.state {
            State::Ready(ReadySimulation {
                arrival: Arrival::Awaited(timer),
                ..
            }) => Some(timer),
            _ => None,
        }
    }

    fn set_arrival(&mut self, arrival: Arrival) {
        if let State::Ready(ready) = &mut self.state {
            ready.arrival = arrival;
        }
    }

    /// Ends the simulation if no viewer is there. A client that is away has its own time limit.
    fn check_arrival(&mut self, ctx: &mut Context<Self>) {
        let Some(wait) = self.awaited() else { return };
        if !self.server.config.ports_are_public() {
            return self.end_unviewed(wait, ctx);
        }
        let State::Ready(ready) = &self.state else { return };
        let port = ready.port;
        let containers = self.server.containers.clone();
        let seen = async move {
            match containers {
                Some(containers) => containers.has_connection(port).await,
                None => spawn_blocking(move || has_connection(port)).await.ok().flatten(),
            }
        };
        let check = seen.into_actor(self).map(move |is_viewed, this, ctx| match is_viewed {
            Some(false) => this.end_unviewed(wait, ctx),
            // What is not known is no reason to end a simulation.
            Some(true) | None => this.settle_arrival(ctx),
        });
        ctx.spawn(check);
    }

    /// Ends the simulation, unless its client is away, or has come back since this wait.
    fn end_unviewed(&mut self, wait: SpawnHandle, ctx: &mut Context<Self>) {
        if self.awaited() == Some(wait) && !matches!(self.client, Client::Away(_)) {
            self.report(StopReason::NoViewer);
            self.finish(StopReason::NoViewer.into(), ctx);
        }
    }
}
