//! Starts that fail through the server's own fault: the clients are sent elsewhere, session servers prefer other
//! servers, and no text for a client contains a path of the machine.

use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::time::Instant;

use super::ends::line;
use crate::support::{
    Client, DEMO, Forge, Server, Webots, arm, demo_server, http, server_of, session_server, simulation_server, until,
    world,
};

async fn failed_starts(server: &Server) -> u64 {
    server.status().await["failedStarts"].as_u64().unwrap()
}

/// A server whose Webots fails until a file exists.
async fn broken(places: u16) -> (Server, tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let repaired = folder.path().join("repaired");
    let webots = Webots::script(&format!(
        "[ -e {} ] || exit 3\n{DEMO} \"$@\" & wait",
        repaired.display()
    ));
    (
        server_of(webots, places).set("isolation", "none").start().await,
        folder,
        repaired,
    )
}

#[actix_rt::test]
async fn a_start_that_fails_because_of_the_server_is_sent_elsewhere() {
    let (server, _folder, repaired) = broken(2).await;
    for count in 1..=3 {
        let mut client = Client::start(&server, &arm()).await;
        let told = client.until("loading: Error:").await;
        let words = "Connect again: the session server chooses another simulation server";
        assert!(
            told.contains("Webots ended with exit code 3.") && told.ends_with(words),
            "{told}"
        );
        assert_eq!(client.closed().await, Some(1013));
        assert_eq!(failed_starts(&server).await, count);
        assert_eq!(line(&server, client.id()).await[10], "launch-failed");
    }
    // A missing world is not the server's fault.
    let mut client = Client::start(&server, &world("lab/arm", "main", "worlds/none.wbt")).await;
    client.until("loading: Error:").await;
    assert_eq!((client.closed().await, failed_starts(&server).await), (Some(1000), 3));
    let metrics = server.metrics().await;
    assert!(metrics.contains("\nwebots_simulation_failed_starts 3\n"), "{metrics}");
    std::fs::write(&repaired, "").unwrap();
    Client::ready(&server).await;
    assert_eq!(failed_starts(&server).await, 0);
}

#[actix_rt::test]
async fn a_webots_that_ends_before_it_listens_has_failed_even_without_an_error() {
    let server = server_of(Webots::script("echo 'wrong program'"), 1).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("loading: Error: Webots has ended").await;
    let told = client.reason();
    assert_eq!(
        (&told["code"], &told["output"]),
        (&"launch-failed".into(), &"wrong program".into())
    );
    assert_eq!((client.closed().await, failed_starts(&server).await), (Some(1013), 1));
}

#[actix_rt::test]
async fn a_black_hole_takes_a_handful_of_clients_and_not_a_class() {
    let (hole, _folder, repaired) = broken(12).await;
    let healthy = demo_server(12).start().await;
    // Other load on this machine must not close the fleet.
    let servers = [healthy.address(), hole.address()];
    let session = session_server(&servers).set("loadThreshold", 1000).start().await;
    let status = async || session.status().await;
    let work = async || {
        status().await["servers"]
            .as_array()
            .unwrap()
            .iter()
            .all(|one| one["state"] == "up")
    };
    until("both work", work).await;
    let mut running = Vec::new();
    let mut failures = 0_u64;
    while running.len() < 10 {
        let given = http::get(&session.url("/session")).await.text();
        let mut client = Client::connect(&format!("{given}/client")).await.asking(&arm()).await;
        loop {
            let text = client.until("").await;
            if text.starts_with("webots:") {
                running.push(client);
                break;
            } else if text.starts_with("loading: Error:") {
                failures += 1;
                assert_eq!(client.closed().await, Some(1013), "{text}");
                break;
            }
        }
        // The session server learns this only from reports: until the next one it would send clients there, too.
        let counted = async || failed_starts(&hole).await == failures;
        until("the black hole has counted its failures", counted).await;
        let since = Instant::now();
        let reported = async || {
            let server = &status().await["servers"][1];
            let taken = server["age"].as_f64().unwrap() + server["latency"].as_f64().unwrap();
            taken < since.elapsed().as_secs_f64()
        };
        until("the black hole has reported its failures", reported).await;
    }
    assert_eq!(failures, 3, "{}", status().await);
    let page = status().await;
    assert!(
        page["servers"][1]["error"]
            .as_str()
            .is_some_and(|why| why.contains("others are preferred")),
        "{page}"
    );
    assert!(
        session
            .log()
            .contains("failed for a reason of its own; others are preferred"),
        "{}",
        session.log()
    );
    // A direct client shows that it works again.
    std::fs::write(&repaired, "").unwrap();
    Client::ready(&hole).await;
    until("it is as good as others", async || {
        status().await["servers"][1]["error"].is_null()
    })
    .await;
}

/// The texts that a client receives when its start fails.
async fn heard(server: &Server, world: &str) -> Vec<String> {
    let mut client = Client::start(server, world).await;
    client.until("loading: Error:").await;
    client.heard
}

#[actix_rt::test]
async fn no_text_for_a_client_holds_a_path_of_the_machine() {
    let forge = Forge::with_arm();
    let end =
        "for last; do :; done\necho \"can't open $last\"; echo \"File '$PWD/controllers/arm/arm.py', $0\" >&2; exit 1";
    let webots = Webots::script(end);
    let server = simulation_server(&webots.path(), forge.path(), 2).start().await;
    let mut all = heard(&server, &arm()).await;
    assert!(
        all.iter().any(|text| text.contains("can't open worlds/a.wbt")),
        "{all:?}"
    );
    for (repository, place) in [("lab/none", "main"), ("lab/arm", "none"), ("lab/arm", "main")] {
        all.extend(heard(&server, &world(repository, place, "worlds/none.wbt")).await);
    }
    all.extend(heard(&server, "https://github.com/../etc/passwd").await);
    // The repositories become unreadable.
    let away = forge.path().with_extension("away");
    std::fs::rename(forge.path(), &away).unwrap();
    std::fs::write(forge.path(), "no folder").unwrap();
    all.extend(heard(&server, &world("lab/arm", "other", "worlds/arm.wbt")).await);
    std::fs::remove_file(forge.path()).unwrap();
    std::fs::rename(&away, forge.path()).unwrap();
    // The cached repositories are broken.
    let cached = std::fs::read_dir(server.folder.join("cache/git"))
        .unwrap()
        .flatten()
        .map(|entry| entry.path());
    for repository in cached.filter(|path| path.is_dir()) {
        std::fs::write(repository.join("config"), "[nonsense").unwrap();
    }
    all.extend(heard(&server, &arm()).await);
    // Webots can't be executed.
    std::fs::set_permissions(webots.path(), std::fs::Permissions::from_mode(0o644)).unwrap();
    all.extend(heard(&server, &arm()).await);
    let temporary = std::env::temp_dir().to_str().unwrap().to_owned();
    for text in &all {
        for path in [
            &temporary,
            "cache/",
            "runs/",
            env!("CARGO_MANIFEST_DIR"),
            "/bin/",
            "/git/",
        ] {
            assert!(!text.contains(path), "{path}: {text}");
        }
    }
    assert!(
        all.iter().filter(|text| text.starts_with("loading: Error:")).count() >= 7,
        "{all:#?}"
    );
}
