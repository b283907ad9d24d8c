//! Many clients, and those that do not behave.

use futures_util::{SinkExt as _, StreamExt as _};
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;

use super::simulator::{DEADLINE, MODEL, MOTION, Start, WORLD, crowded_project, project, small_project};
use super::viewer::time_of;

#[tokio::test]
async fn many_viewers_see_the_same() {
    let project = small_project();
    let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
    let mut viewers = Vec::new();
    for _ in 0..50 {
        viewers.push(simulator.spectator().await);
    }
    viewers[0].say("step").await;
    for viewer in &mut viewers {
        viewer.hears(&["application/json:{\"time\":10,"]).await;
    }
}

#[tokio::test]
async fn a_large_world_is_shown_whole() {
    let solids = "<Solid name=\"one of a great many solids\"/>".repeat(40_000);
    let model = MODEL.replace("</Scene>", &format!("{solids}</Scene>"));
    let project = project(&[("a.wbt", WORLD), ("a.x3d", &model), ("a.motion.json", MOTION)]);
    let world = project.path().join("worlds/a.wbt");
    let simulator = Start::paused(&world).playing().await;
    let mut viewer = simulator.spectator().await;
    viewer.say("step").await;
    viewer.hears(&["application/json:", "paused by client"]).await;
    viewer.say("reload").await;
    viewer.hears(&["delete world", "loading:"]).await;
    viewer.hears(&["loading:", "loading:", "world:"]).await;
    assert_eq!(viewer.hear().await.matches("<Solid ").count(), 40_001);
}

#[tokio::test]
async fn a_viewer_that_does_not_read_is_dropped_and_the_others_go_on() {
    let project = crowded_project(5000);
    let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
    let mut deaf = simulator.spectator().await;
    let mut other = simulator.spectator().await;
    for _ in 0..100 {
        other.say("reset").await;
        while other.hear().await != "reset finished" {}
    }
    // when it reads on, it finds what was sent before, and the end
    let rest = async {
        while let Some(message) = deaf.socket.next().await {
            match message {
                Ok(Message::Text(_)) => (),
                Ok(Message::Close(Some(frame))) => return frame.code,
                other => panic!("expected the end, got {other:?}"),
            }
        }
        panic!("there was no close frame")
    };
    assert_eq!(timeout(DEADLINE, rest).await.expect("no end in time"), CloseCode::Policy);
    other.say("pause").await;
    other.hears(&["paused by client"]).await;
}

#[tokio::test]
async fn a_viewer_that_never_stops_talking_is_sent_away() {
    // each reset takes a while
    let project = crowded_project(3000);
    let world = project.path().join("worlds/a.wbt");
    let simulator = Start::paused(&world).playing().await;
    let (mut talking, mut hearing) = simulator.viewer().await.socket.split();
    let talk = async { while talking.send(Message::text("reset")).await.is_ok() {} };
    let hear = async {
        match hearing.next().await {
            Some(Ok(Message::Close(Some(frame)))) => assert_eq!(frame.code, CloseCode::Policy),
            // the rest of its flood may break the connection before the goodbye is read
            Some(Err(_)) => (),
            other => panic!("expected to be sent away, got {other:?}"),
        }
    };
    let both = async { tokio::join!(talk, hear) };
    timeout(DEADLINE, both).await.expect("was not sent away in time");
    simulator.spectator().await;
}

#[tokio::test]
async fn a_viewer_that_reads_too_slowly_misses_updates_but_sees_the_last() {
    let project = crowded_project(3000);
    let world = project.path().join("worlds/a.wbt");
    let simulator = Start::paused(&world).playing().await;
    let mut slow = simulator.spectator().await;
    let mut other = simulator.spectator().await;
    other.say("real-time:-1").await;
    other.hears(&["real-time"]).await;
    let mut received = Vec::new();
    while received.len() < 60 {
        received.push(other.hear().await);
    }
    other.say("pause").await;
    received.extend(other.hears_after_updates("paused by client").await);
    slow.say("pause").await;
    let seen = slow.hears_after_updates("paused by client").await;
    assert!(seen.len() < received.len(), "{} of {}", seen.len(), received.len());
    let [seen, received] = [seen, received].map(|updates| updates.last().unwrap().clone());
    assert!((time_of(&seen) - time_of(&received)).abs() < 1.0);
    assert_eq!(seen.matches("\"id\"").count(), 3000);
}

#[tokio::test]
async fn a_viewer_that_says_goodbye_is_answered() {
    let project = small_project();
    let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
    let mut viewer = simulator.spectator().await;
    viewer.socket.close(None).await.unwrap();
    assert!(matches!(timeout(DEADLINE, viewer.socket.next()).await, Ok(Some(Ok(Message::Close(_))) | None)));
    simulator.spectator().await;
}

#[tokio::test]
async fn a_viewer_that_sends_bytes_is_sent_away() {
    let project = small_project();
    let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
    let mut viewer = simulator.spectator().await;
    viewer.socket.send(Message::binary(vec![1, 2, 3])).await.unwrap();
    viewer.is_closed(CloseCode::Unsupported).await;
    let mut viewer = simulator.spectator().await;
    viewer.socket.send(Message::text("x".repeat(100_000))).await.unwrap();
    viewer.is_closed(CloseCode::Protocol).await;
}
