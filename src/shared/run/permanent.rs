//! Actors without which a server can't go on.

use std::time::Duration;

use actix::prelude::*;

/// Between two looks.
const LOOK: Duration = Duration::from_millis(500);

/// Waits until an actor that must live is gone. That is a fault in this program: it has panicked.
///
/// actix doesn't restart an actor after a panic, and every later message to it fails, so that the server had better end
/// and be started again.
pub async fn gone<A: Actor>(name: &str, actor: Addr<A>) -> String {
    while actor.connected() {
        actix_rt::time::sleep(LOOK).await;
    }
    format!("the actor {name} is gone")
}
