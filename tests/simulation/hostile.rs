//! Requests and Git hosts that say sentences of git, Docker, the kernel and this server: they change neither who is blamed
//! for a failed start, nor the reason. `sentences` has what projects print.

use super::opened::reader;
use crate::support::wrapper::Wrapper;
use crate::support::{Client, Forge, Server, arm, sentences, simulation_server, world};

/// Sentences that mean something when git, Docker, the kernel or this server prints them.
const SENTENCES: [&str; 14] = [
    "No space left on device",
    "Disk quota exceeded",
    "Input-output error, Input output error",
    "Cannot allocate memory",
    "Resource temporarily unavailable",
    "Could not resolve host",
    "Failed to connect to",
    "SSL certificate problem",
    "returned error: 301",
    "invalid index-pack output",
    "not our ref",
    "bad object, corrupt, unable to read",
    "Cannot connect to the Docker daemon",
    "This simulation server's disk is full",
];

/// The error of a start, and the close code.
async fn failure(server: &Server, world: &str) -> (String, Option<u16>) {
    let mut client = Client::start(server, world).await;
    (client.until("loading: Error:").await, client.closed().await)
}

async fn failed_starts(server: &Server) -> u64 {
    server.status().await["failedStarts"].as_u64().unwrap()
}

#[actix_rt::test]
async fn what_a_client_asks_for_blames_no_server() {
    let forge = Forge::with_arm();
    let webots = reader();
    let server = simulation_server(&webots.path(), forge.path(), 8).start().await;
    for sentence in SENTENCES {
        let escaped = sentence.replace(' ', "%20");
        let table = [
            (
                world(&format!("lab/{escaped}"), "main", "worlds/a.wbt"),
                "does not exist or is not public",
            ),
            (
                world("lab/arm", &escaped, "worlds/a.wbt"),
                "has no branch, tag or commit called",
            ),
            (
                world("lab/arm", "main", &format!("worlds/{escaped}.wbt")),
                "does not exist",
            ),
        ];
        for (url, words) in table {
            let told = failure(&server, &url).await;
            assert!(told.0.contains(words), "{url}: {told:?}");
            assert_eq!(told.1, Some(1000), "{url}: {told:?}");
        }
    }
    assert_eq!(failed_starts(&server).await, 0);
}

#[actix_rt::test]
async fn what_a_remote_prints_does_not_decide() {
    let forge = Forge::with_arm();
    let webots = reader();
    let said = sentences::all()
        .iter()
        .map(|line| format!("fatal: {line}\nremote: {line}\n"))
        .collect::<String>();
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), said).unwrap();
    // Each query fails, with all sentences on its standard error.
    let wrapper = Wrapper::git(&format!(
        "case \" $* \" in *\" ls-remote \"*) cat {} >&2; exit 128;; esac",
        file.path().display()
    ));
    let builder = simulation_server(&webots.path(), forge.path(), 2).env("PATH", &wrapper.path());
    let server = builder.start().await;
    let told = failure(&server, &arm()).await;
    assert!(
        told.0
            .contains("can't be checked out: git ls-remote ended with exit code 128"),
        "{told:?}"
    );
    assert_eq!((told.1, failed_starts(&server).await), (Some(1000), 0), "{told:?}");
}
