//! Ends of simulations: the same id in messages, log, `simulations.csv`, counters, monitor and output.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::support::http::{PASSWORD, get_as_administrator};
use crate::support::{Client, DEMO, Forge, Server, Webots, arm, http, server_of, simulation_server, until, world};

/// A simulator that exits with the code in this file, once the file exists.
fn ending(file: &Path) -> Webots {
    let begun = "printf 'begun\\nred \\033[31m text\\n\\377 no text\\n' >&2";
    let demo = format!("{DEMO} \"$@\" >/dev/null 2>&1 &");
    let file = file.display();
    let ended = format!("until [ -e {file} ]; do sleep 0.02; done\nprintf 'last words\\nwithout end'");
    Webots::script(&format!(
        "{begun}\n{demo}\n{ended}\nkill %1 2>/dev/null\nexit $(cat {file})"
    ))
}

/// A server with one such simulator, and the file with its folder.
async fn ending_server() -> (Server, tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("code");
    (
        server_of(ending(&file), 1).set("isolation", "none").start().await,
        folder,
        file,
    )
}

/// The lines of `simulations.csv` without the header.
fn lines(server: &Server) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(server.folder.join("log/simulation/simulations.csv")).unwrap_or_default();
    text.lines()
        .skip(1)
        .map(|line| line.split(',').map(|text| text.trim_matches('"').to_owned()).collect())
        .collect()
}

/// Waits for the line of a simulation; returns its columns.
pub async fn line(server: &Server, id: &str) -> Vec<String> {
    let find = || lines(server).into_iter().find(|line| line[0] == id);
    until("its end is in simulations.csv", async || find().is_some()).await;
    find().unwrap()
}

async fn ends(server: &Server, reason: &str) -> f64 {
    let metrics = server.metrics().await;
    let begin = format!("webots_simulation_ends_total{{reason=\"{reason}\"}} ");
    metrics
        .lines()
        .find_map(|line| line.strip_prefix(&begin))
        .unwrap_or_else(|| panic!("{metrics}"))
        .parse()
        .unwrap()
}

#[actix_rt::test]
async fn a_simulation_keeps_one_id() {
    let (server, _folder, file) = ending_server().await;
    let mut client = Client::ready(&server).await;
    assert!(client.heard[0].starts_with("session: "), "{:?}", client.heard);
    let id = client.id().to_owned();
    let status: Value = server.status().await;
    assert_eq!(status["simulations"][0]["id"], id.as_str());
    assert!(server.monitor().await.contains(&id));
    let url = server.url(&format!("/output?id={id}"));
    let begun = "begun\nred  [31m text\n\u{fffd} no text\n";
    assert_eq!(http::get(&url).await.text(), begun);
    std::fs::write(&file, "3").unwrap();
    let told = client.until("loading: Error:").await;
    assert!(told.contains("Webots ended with exit code 3"), "{told}");
    let port = (server.port + 1).to_string();
    let line = line(&server, &id).await;
    let world = arm();
    let expected = ["127.0.0.1", "https://github.com/lab/arm", &world, &port, "none"];
    assert_eq!(line[3..8], expected, "{line:?}");
    assert!(
        line[1] <= line[2] && line[1].ends_with('Z') && line[10] == "crashed",
        "{line:?}"
    );
    assert_eq!(
        (ends(&server, "crashed").await, ends(&server, "left").await),
        (1.0, 0.0)
    );
    let kept = async || http::get(&url).await.text();
    until("the output is kept with the events", async || {
        kept().await.contains("ended (crashed)")
    })
    .await;
    let kept = kept().await;
    let printed = format!("{begun}last words\nwithout end");
    for words in [
        "asks for https://github.com/lab/arm",
        "Z ready\n",
        "Webots ended with exit code 3",
        &printed,
    ] {
        assert!(kept.contains(words), "{words:?}: {kept}");
    }
    let page = server.monitor().await;
    assert!(
        page.contains("crashed") && page.contains(&format!("output?id={id}")),
        "{page}"
    );
    assert!(
        !page.contains("last words"),
        "who may see the page may not see the output"
    );
    let log = server.log();
    for words in [
        "asks for https",
        "is for Webots",
        "started ",
        ": ready",
        "Webots ended with exit code 3",
    ] {
        assert!(
            log.lines().any(|line| line.contains(&id) && line.contains(words)),
            "{words:?}: {log}"
        );
    }
}

#[actix_rt::test]
async fn a_kept_output_stays_whatever_is_printed_afterwards() {
    // A process that outlives its Webots prints without end as soon as the output is kept, and for more than one file.
    let folder = tempfile::tempdir().unwrap();
    let forge = Forge::with_arm();
    let logs = folder.path().join("log/simulation");
    let flood = format!(
        "touch left; until ls {}/ended/*.log; do sleep 0.02; done 2>/dev/null >&2; exec yes 'a flood of lines'",
        logs.display()
    );
    let webots = Webots::script(&format!(
        "setsid sh -c \"{flood}\" &\nuntil [ -e left ]; do sleep 0.02; done\necho last words\nexit 3"
    ));
    let server = simulation_server(&webots.path(), forge.path(), 1)
        .folder(folder.path())
        .set("isolation", "none")
        .set("limits.output", 100_000)
        .start()
        .await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("loading: Error:").await;
    let id = client.id().to_owned();
    until("much was printed", async || {
        logs.join(format!("instances/{id}.log.1")).exists()
    })
    .await;
    let kept = std::fs::read_to_string(logs.join(format!("ended/{id}.log"))).unwrap();
    assert!(
        kept.starts_with("last words") && kept.contains("What has happened:"),
        "{} bytes",
        kept.len()
    );
}

#[actix_rt::test]
async fn each_kind_of_end_is_told_as_such() {
    let (mut server, _folder, file) = ending_server().await;
    let start = async || Client::ready(&server).await;
    // Webots exits normally.
    let mut finished = start().await;
    std::fs::write(&file, "0").unwrap();
    finished.until("loading: Webots has ended").await;
    assert_eq!(line(&server, finished.id()).await[10], "finished");
    std::fs::remove_file(&file).unwrap();
    // Its client leaves.
    let gone = start().await;
    let id = gone.id().to_owned();
    gone.leave().await;
    assert_eq!(line(&server, &id).await[10], "left");
    // Its world does not exist: no output is kept.
    let mut nowhere = Client::start(&server, &world("lab/arm", "main", "worlds/none.wbt")).await;
    nowhere.until("loading: Error:").await;
    let line_of_it = line(&server, nowhere.id()).await;
    assert_eq!(line_of_it[8..13], ["", "", "world-not-found", "", ""], "{line_of_it:?}");
    let output = server.url(&format!("/output?id={}", nowhere.id()));
    assert_eq!(http::get(&output).await.status.as_u16(), 404);
    // The server stops while one client waits and another's simulation runs.
    let running = start().await;
    let mut waiting = Client::start(&server, &arm()).await;
    waiting.until("queue:").await;
    server.stops().await;
    let last = lines(&server);
    for client in [&running, &waiting] {
        let line = last
            .iter()
            .find(|line| line[0] == client.id())
            .unwrap_or_else(|| panic!("{last:?}"));
        assert_eq!(line[10], "server-stopped", "{line:?}");
    }
    assert_eq!(last.len(), 5, "{last:?}");
}

#[actix_rt::test]
async fn what_is_kept_needs_the_password_where_there_is_one() {
    let server = server_of(Webots::script("exit 7"), 1)
        .set("adminPassword", PASSWORD)
        .start()
        .await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("loading: Error:").await;
    line(&server, client.id()).await;
    let url = server.url(&format!("/output?id={}", client.id()));
    assert_eq!(http::get(&url).await.status.as_u16(), 401);
    until("it is kept", async || get_as_administrator(&url).await.status == 200).await;
    for id in ["..%2F..%2Fconfig", "%2Fetc%2Fpasswd", "1-1", ""] {
        let url = server.url(&format!("/output?id={id}"));
        assert_eq!(get_as_administrator(&url).await.status, 404, "{id}");
    }
}

#[actix_rt::test]
async fn hidden_letters_in_a_worlds_name_are_shown() {
    let forge = Forge::new();
    let text = "#VRML_SIM R2025a utf8\n";
    let file = "a\u{202e}b\u{2028}\u{200b}.wbt";
    let encoded = "c%E2%80%AEd%E2%80%A8.wbt";
    let decoded = "worlds/c\u{202e}d\u{2028}.wbt";
    forge.commit("lab/arm", "main", &[(&format!("worlds/{file}"), text), (decoded, text)]);
    let webots = Webots::launcher();
    let server = simulation_server(&webots.path(), forge.path(), 2).start().await;
    let mut clients = Vec::new();
    for name in [file, encoded] {
        let mut client = Client::start(&server, &world("lab/arm", "main", &format!("worlds/{name}"))).await;
        client.until("webots:").await;
        clients.push(client);
    }
    let hides = |text: &str| text.contains(['\u{202e}', '\u{2028}', '\u{200b}']);
    let page = server.monitor().await;
    assert!(
        page.contains("a\u{fffd}b \u{fffd}.wbt") && page.contains("%E2%80%AEb"),
        "{page}"
    );
    assert!(!hides(&page), "{page}");
    for client in clients {
        client.leave().await;
    }
    let page = async || server.monitor().await;
    until("their ends are shown", async || {
        page().await.matches("data-label=\"After\"").count() == 2
    })
    .await;
    let page = page().await;
    assert!(!hides(&page) && !hides(&server.log()), "{page}");
}
