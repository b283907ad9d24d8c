//! How a session keeps its simulation ready without a client, and continues with the client that takes it.

use std::sync::Arc;
use std::time::Instant;

use actix::prelude::*;

use super::session::{Client, Comeback, Expected, Session, SpareEvent, State};
use crate::shared::domain::{Failure, Reason, ReservationId};
use crate::simulation::attachment::NewClient;
use crate::simulation::checkout::Tip;
use crate::simulation::protocol;
use crate::simulation::simulation_id::SimulationId;
use crate::simulation::slots::{Slot, SpareKind};
use crate::simulation::state::AppState;
use crate::simulation::webots::HasClient;

impl Session {
    /// Opens the session of a simulation without a client, if there is a free slot that no client waits for.
    pub(super) fn open_spare(
        server: &Arc<AppState>,
        kind: SpareKind,
        tip: Option<Tip>,
        keeper: Recipient<SpareEvent>,
    ) -> Addr<Self> {
        let id = SimulationId::next();
        let server = Arc::clone(server);
        Self::create(|ctx| {
            let slot = Slot::for_spare(&server.slots, id, ctx.address().recipient(), kind.clone());
            let world = kind.world.clone();
            let mut session = Self {
                server,
                id,
                view: kind.view,
                client: Client::Expected(Expected { kind, keeper }),
                state: State::lost(),
            };
            if let Some(slot) = slot {
                log::info!("{id}: is kept ready with {world}");
                session.check_out(world, tip, slot, ctx);
            } else {
                ctx.stop();
            }
            session
        })
    }

    /// Ends a session that has no client, unless one has just taken the simulation.
    pub(super) fn finish_spare(&mut self, failure: Failure, ctx: &mut Context<Self>) {
        let Client::Expected(Expected { kind, keeper }) = &self.client else {
            return;
        };
        log::info!("{}: {failure} ({})", self.name(), failure.reason);
        if !matches!(failure.reason, Reason::Left | Reason::ServerStopped) {
            keeper.do_send(SpareEvent::Failed(kind.clone(), failure.clone()));
        }
        let has_no_client = self.server.slots.give_up_spare(self.id);
        self.state = State::Over(failure);
        // Otherwise that client is on its way.
        if has_no_client {
            ctx.stop();
        }
    }

    /// A client takes the simulation. If that has failed, it starts another one with the reservation `again`.
    pub(super) fn taken_by(&mut self, client: NewClient, again: ReservationId, ctx: &mut Context<Self>) {
        if let State::Over(_) = self.state {
            Self::start_for(Arc::clone(&self.server), client, Some(again));
            return ctx.stop();
        }
        self.server.slots.taken(self.id, again);
        let NewClient {
            connection,
            identity,
            resumable,
            early,
            ..
        } = client;
        let peer = connection.peer;
        log::info!("{}: client {peer}: takes it{identity}", self.id);
        self.client = Client::Connected(Self::attached(connection, Comeback::asked(resumable), ctx));
        self.text(protocol::simulation_id(self.id));
        if early {
            self.issue_token(ctx);
            self.offer_comeback();
        }
        if let Some(launched) = self.state.launched_mut() {
            launched.started = Some(Instant::now());
        }
        if let Some(launched) = self.state.launched() {
            launched.webots.0.do_send(HasClient);
            self.text(protocol::shutdown_timeout(self.server.config.timeout));
            self.texts(launched.texts.iter().cloned());
        }
        if let State::Ready(_) = self.state {
            self.hand_over(ctx);
        }
    }
}
