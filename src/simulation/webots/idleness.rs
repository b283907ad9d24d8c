//! How a simulation ends that stays paused. Some time before, its client is told, and may keep it.
//!
//! What a page says to Webots does not pass this server: that a simulation is paused is known from what Webots prints.

use std::time::{Duration, Instant};

use actix::prelude::*;

use super::event::WebotsEvent;
use super::webots::{IdleEnd, Webots};
use crate::simulation::ends::EndReason;

/// So long before its end the client is told; where `idleTimeout` is shorter than twice that, half of it before.
const NOTICE: Duration = Duration::from_mins(2);

/// Asks to keep a simulation that is paused: `idleTimeout` begins again.
#[derive(Message)]
#[rtype(result = "()")]
pub struct Keep;

impl Webots {
    /// Somebody has done something with the simulation: if it is paused now, its `idleTimeout` begins.
    pub(super) fn used(&mut self, ctx: &mut Context<Self>) {
        if let Some(IdleEnd { timer, is_told }) = self.idle_end.take() {
            ctx.cancel_future(timer);
            if is_told {
                self.tell(WebotsEvent::IdleEnd(None));
            }
        }
        let limit = self.spec.config.idle_timeout;
        if limit.is_zero() || self.runs || !self.listening {
            return;
        }
        let notice = NOTICE.min(limit / 2);
        let timer = ctx.run_later(limit.saturating_sub(notice), move |this, ctx| {
            this.tell(WebotsEvent::IdleEnd(Some(Instant::now() + notice)));
            let timer = ctx.run_later(notice, move |this, _| {
                let minutes = limit.as_secs_f64() / 60.0;
                this.stop(EndReason::Idle, &format!("The simulation was paused for {minutes} minutes"));
            });
            this.idle_end = Some(IdleEnd { timer, is_told: true });
        });
        self.idle_end = Some(IdleEnd { timer, is_told: false });
    }
}

impl Handler<Keep> for Webots {
    type Result = ();

    fn handle(&mut self, _: Keep, ctx: &mut Self::Context) {
        self.used(ctx);
    }
}
