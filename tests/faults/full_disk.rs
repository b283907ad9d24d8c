//! Two servers, one of them with a full disk, and a class of 16, whose simulations must all run. The disk fills up
//! while simulations run, and is emptied again.

use std::path::Path;

use crate::fleet::try_start;
use crate::support::disk::{self, Full};
use crate::support::{Builder, Client, Server, arm, demo_server, http, session_server, skip, until};

/// Number of clients.
const CLASS: u16 = 16;

fn server(folder: &Path) -> Builder {
    std::fs::create_dir_all(folder).unwrap();
    // The small disk has 64 MiB.
    demo_server(CLASS).folder(folder).set("diskReserve", 8)
}

/// The state of the second simulation server, and its last error.
async fn second(session: &Server) -> (String, String) {
    let page = session.status().await;
    let text = |key: &str| page["servers"][1][key].as_str().unwrap_or_default().to_owned();
    (text("state"), text("error"))
}

/// A class that comes one by one: each client after the one before has its simulation.
async fn class(session: &Server, clients: u16) -> Vec<Client> {
    let mut class = Vec::new();
    for number in 1..=clients {
        let given = http::get(&session.url("/session")).await.text();
        let client = try_start(&given).await;
        class.push(client.unwrap_or_else(|why| panic!("client {number} of {clients}: {why}")));
    }
    class
}

#[actix_rt::test]
async fn a_server_with_a_full_disk_takes_nobody() {
    disk::hide_mounts_from_others();
    let folder = tempfile::tempdir().unwrap();
    let small = folder.path().join("small");
    if !disk::small_disk(&small, 64) {
        return skip("only root may mount one");
    }
    let healthy = server(&folder.path().join("healthy")).start().await;
    let full = server(&small).start().await;
    let session = session_server(&[healthy.address(), full.address()])
        .set("loadThreshold", 1000)
        .start()
        .await;
    until("both work", async || second(&session).await.0 == "up").await;

    // The disk fills up while the server has a simulation.
    let mut running = try_start(&format!("ws://{}", full.address())).await.unwrap();
    let filler = Full::at(&small);
    until("the full one is not offered", async || {
        second(&session).await.0 == "down"
    })
    .await;
    let (_, why) = second(&session).await;
    assert!(
        why.contains("disk is full: less than 8 MiB are left (diskReserve)"),
        "{why}"
    );
    let (status, text) = full.health().await;
    assert!(status == 503 && text.contains("disk is full"), "{text}");
    let page = full.monitor().await;
    assert!(page.contains("Not ready") && page.contains("disk is full"), "{page}");
    let mut refused = Client::start(&full, &arm()).await;
    assert!(refused.until("loading: Error:").await.contains("disk is full"));
    assert_eq!(refused.closed().await, Some(1013), "another server may take it");
    let all = class(&session, CLASS).await;
    assert_eq!(healthy.simulations().await.len(), usize::from(CLASS));
    running.until(".").await;

    // The disk is emptied.
    drop(filler);
    until("it is offered again", async || second(&session).await.0 == "up").await;
    assert_eq!(full.health().await.0, 200);
    for client in all {
        client.leave().await;
    }
    running.leave().await;
    class(&session, 4).await;
}
