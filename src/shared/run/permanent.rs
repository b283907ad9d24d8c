//! Actors that must run as long as the server.

use std::time::Duration;

use actix::prelude::*;

/// Interval between two checks of an actor.
const INTERVAL: Duration = Duration::from_millis(500);

/// Waits until an actor has stopped, and returns a message about it. Such an actor has panicked, which is a bug in this
/// program, or has given up on others that panic.
///
/// actix does not restart an actor after a panic, and every later message to it fails. The server must exit, and its
/// service manager restarts it.
pub async fn stopped<A: Actor>(name: &str, actor: Addr<A>) -> String {
    while actor.connected() {
        actix_rt::time::sleep(INTERVAL).await;
    }
    format!("the actor {name} is gone")
}
