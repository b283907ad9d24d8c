//! Questions to the slot pool on behalf of a request.

use std::time::Duration;

use actix::dev::ToEnvelope;
use actix::prelude::*;
use actix_web::error::ErrorServiceUnavailable;

use crate::simulation::slots::SlotPool;
use crate::simulation::state::AppState;

/// Timeout of the slot pool's answer to a page.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);

/// Asks the slot pool.
///
/// # Errors
/// The response to the request, when the actor does not answer in time.
pub async fn ask<M>(server: &AppState, question: M) -> actix_web::Result<M::Result>
where
    M: Message<Result: Send> + Send + 'static,
    SlotPool: Handler<M>,
    Context<SlotPool>: ToEnvelope<SlotPool, M>,
{
    let answer = actix_rt::time::timeout(ANSWER_TIMEOUT, server.slots.send(question)).await;
    answer.ok().and_then(Result::ok).ok_or_else(|| ErrorServiceUnavailable("Error: the server is too busy to tell."))
}
