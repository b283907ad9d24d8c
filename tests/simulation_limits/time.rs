//! The time limit of a simulation: it counts from the start of Webots.

use std::time::{Duration, Instant};

use webots_fleet::shared::domain::Reason;
use webots_fleet::shared::domain::Stage;
use webots_fleet::simulation::config::Streaming;

use crate::inside::Inside;
use crate::support::{Client, until};

pub async fn a_simulation_ends_at_its_time_limit_in_any_state() {
    // At level `none`, hidden processes live as long as the server.
    needs!("bwrap");
    for stage in [Stage::Launching, Stage::Idle, Stage::Running, Stage::Stopping] {
        let inside = Inside::new(stage, |config| {
            config.timeout = 5;
            config.streaming = Streaming::Relay;
            config.timing.grace = Duration::from_millis(500);
        })
        .await;
        let mut client = inside.client().await;
        let begin = Instant::now();
        assert_eq!(client.until("shutdownTimeout").await, "shutdownTimeout: 5");
        if stage != Stage::Stopping {
            inside.until(stage).await;
        }
        let mut viewer = None;
        if stage == Stage::Running {
            let address = client.until("webots:").await;
            let stream = Client::connect(address.strip_prefix("webots:").unwrap()).await;
            viewer = Some(stream.with_running_scene().await);
        }
        let told = client.until("loading: Error:").await;
        assert!(
            told.starts_with("loading: Error: The time limit of 5 seconds was reached"),
            "{stage:?}: {told}"
        );
        assert_eq!(client.closed().await, Some(1000), "{stage:?}");
        if let Some(mut viewer) = viewer {
            let reason = "The time limit of 5 seconds was reached".to_owned();
            assert_eq!(viewer.closed_with().await, Some((1000, reason)));
            let last = viewer.heard.last().unwrap();
            assert!(last.starts_with("application/json:"), "the time ran: {last}");
        }
        assert!(
            begin.elapsed() >= Duration::from_secs(5),
            "{stage:?}: it came too early"
        );
        inside.until_nothing_is_left().await;
        assert_eq!(
            inside.server.ends.latest()[0].end.failure.reason,
            Reason::TimeLimit,
            "{stage:?}"
        );
        inside.stop().await;
    }
}

/// No client can hold a slot forever by resuming: the limit counts from the first start.
pub async fn who_is_away_at_the_time_limit_hears_it() {
    let inside = Inside::new(Stage::Idle, |config| config.timeout = 5).await;
    let begin = Instant::now();
    let (client, token) = inside.connect().await.start_resumable().await;
    drop(client);
    until("it has ended", async || inside.stages().is_empty()).await;
    assert!(begin.elapsed() >= Duration::from_secs(5), "{:?}", begin.elapsed());
    let mut client = inside.connect().await.resume(&token).await;
    let told = client.until("loading: Error:").await;
    let words = "loading: Error: this simulation has ended: The time limit of 5 seconds was reached";
    assert!(told.starts_with(words), "{told}");
    assert_eq!(client.closed().await, Some(1000));
    inside.until_nothing_is_left().await;
    assert_eq!(inside.server.ends.latest()[0].end.failure.reason, Reason::TimeLimit);
    inside.stop().await;
}
