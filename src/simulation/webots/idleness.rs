//! Ends a simulation that stays paused. Its client is notified before, and can keep it.
//!
//! The server does not read the messages between a page and Webots: Webots' output shows that a simulation is paused.

use std::time::{Duration, Instant};

use actix::prelude::*;

use super::event::WebotsEvent;
use super::webots::{IdleEnd, Ready, State, Webots};
use crate::shared::domain::{Failure, Reason};

/// Time between the notice to the client and the end; at most half of `idleTimeout`.
const NOTICE: Duration = Duration::from_mins(2);

/// Requests to keep a simulation that is paused: `idleTimeout` begins again.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Keep;

impl Webots {
    /// Records that the simulation was used: if it is paused now, its `idleTimeout` begins.
    pub(super) fn used(&mut self, ctx: &mut Context<Self>) {
        let State::Ready(Ready { process, idle_end, .. }) = &mut self.state else {
            return;
        };
        let is_running = process.is_running;
        if let Some(IdleEnd { timer, is_announced }) = idle_end.take() {
            ctx.cancel_future(timer);
            if is_announced {
                self.send(WebotsEvent::IdleEnd(None));
            }
        }
        let minutes = self.spec.config.idle_timeout;
        let limit = Duration::from_secs_f64(60.0 * minutes);
        if limit.is_zero() || is_running || !self.has_client {
            return;
        }
        let notice = NOTICE.min(limit / 2);
        let timer = ctx.run_later(limit.saturating_sub(notice), move |this, ctx| {
            this.send(WebotsEvent::IdleEnd(Some(Instant::now() + notice)));
            let timer = ctx.run_later(notice, move |this, ctx| {
                let message = format!("The simulation was paused for {minutes} min");
                this.stop(Failure::new(Reason::Idle, message), ctx);
            });
            this.set_idle_end(timer, true);
        });
        self.set_idle_end(timer, false);
    }

    fn set_idle_end(&mut self, timer: SpawnHandle, is_announced: bool) {
        if let State::Ready(ready) = &mut self.state {
            ready.idle_end = Some(IdleEnd { timer, is_announced });
        }
    }
}

impl Handler<Keep> for Webots {
    type Result = ();

    fn handle(&mut self, _: Keep, ctx: &mut Self::Context) {
        self.used(ctx);
    }
}
