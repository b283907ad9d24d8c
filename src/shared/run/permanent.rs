//! Actors that must live as long as the server.

use std::time::Duration;

use actix::prelude::*;

/// How often an actor is looked at.
const INTERVAL: Duration = Duration::from_millis(500);

/// Waits until an actor has stopped, and returns a sentence that says so. It has panicked: this is a fault in this program.
///
/// actix does not restart an actor after a panic, and every later message to it fails. The server must end and be started
/// again.
pub async fn stopped<A: Actor>(name: &str, actor: Addr<A>) -> String {
    while actor.connected() {
        actix_rt::time::sleep(INTERVAL).await;
    }
    format!("the actor {name} is gone")
}
