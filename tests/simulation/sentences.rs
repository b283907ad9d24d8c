//! Projects that print, or are named by, all sentences of this project and those of git, Docker and the kernel: neither
//! the reason of an end, nor who is blamed, nor a metric, nor what the viewer page does depends on it.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use serde_json::{Value, json};

use super::opened::{reader, world_text};
use crate::support::{Client, DEMO, Forge, Server, Webots, sentences, simulation_server, until, world};

/// Number of lines of an output that are sent with an end, and the largest number of bytes in each.
const SENT: (usize, usize) = (20, 900);
/// What is printed instead of a sentence.
const NEUTRAL: &str = "a line that means nothing";
/// The progress of a fetch.
const FETCH: [&str; 4] = [
    "loading: Step",
    r#"progress: {"step":"search""#,
    r#"progress: {"step":"fetch""#,
    r#"progress: {"step":"write""#,
];
/// How a Webots ends whose project prints something before that: the world, and the code of the reason.
const ENDS: [(&str, &str); 5] = [
    ("launch", "launch-failed"),
    ("load", "load-failed"),
    ("crash", "crashed"),
    ("finish", "finished"),
    ("run", "left"),
];

/// A Webots that prints the file `FOLDER/NUMBER` on both streams in each phase that it reaches. The name of its world is
/// `END-NUMBER.wbt`; it ends once there is a file `FOLDER/END-NUMBER`.
fn printer(folder: &Path) -> Webots {
    let folder = folder.display();
    Webots::script(&format!(
        r#"for last; do :; done
name=$(basename "$last" .wbt)
say() {{ cat {folder}/${{name#*-}}; cat {folder}/${{name#*-}} >&2; }}
say
case $name in launch-*) exit 1;; esac
{DEMO} "$@" &
until [ -e {folder}/$name ]; do say >/dev/null; sleep 0.02; done
say
case $name in
    run-*) wait; exit;;
esac
kill $!
case $name in
    finish-*) exit 0;;
    *) exit 1;;
esac"#
    ))
}

/// All sentences, each once on a line of its own, and once among the last lines of an output.
fn lists() -> Vec<Vec<String>> {
    let (last, length) = SENT;
    let all = sentences::all();
    let mut joined = vec![String::new()];
    for sentence in &all {
        if joined.last().unwrap().len() + sentence.len() > length {
            joined.push(String::new());
        }
        let line = joined.last_mut().unwrap();
        *line = format!("{line}{sentence} | ");
    }
    let ends: Vec<_> = joined.chunks(last).collect();
    let lists = all.chunks(all.len().div_ceil(ends.len())).zip(ends);
    lists.map(|(single, end)| [single, end].concat()).collect()
}

/// What was received on a connection.
struct Transcript {
    texts: Vec<String>,
    code: Option<u16>,
}

impl Transcript {
    /// Without the signs of life and the progress of the fetch, whose number differs between two runs.
    fn to_replay(&self) -> Vec<String> {
        let varies = |text: &str| text == "." || FETCH.iter().any(|begin| text.starts_with(begin));
        let is_the_same = |text: &&String| !varies(text);
        self.texts.iter().filter(is_the_same).cloned().collect()
    }

    /// Without what differs between two runs, and without what is printed by the project.
    fn meaning(&self) -> (Vec<String>, Option<u16>) {
        let is_the_same = |text: &&String| {
            let varies = ["session:", "webots:", ".", "shutdownTimeout:"];
            !varies.iter().chain(&FETCH).any(|begin| text.starts_with(begin))
        };
        let meaning = |text: &String| match text.strip_prefix("reason: ") {
            Some(fields) => {
                let mut fields: Value = serde_json::from_str(fields).unwrap();
                let output = fields.as_object_mut().unwrap().remove("output");
                assert_eq!(output.is_some(), fields["code"] != "finished", "{fields}");
                fields.to_string()
            }
            None => text.split("Its last output: ").next().unwrap().to_owned(),
        };
        (self.texts.iter().filter(is_the_same).map(meaning).collect(), self.code)
    }
}

/// A server, and the folder of what its simulations print.
struct Stage {
    server: Server,
    folder: tempfile::TempDir,
    _forge: Forge,
    _webots: Webots,
}

impl Stage {
    async fn with(lists: &[Vec<String>]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let forge = Forge::new();
        let mut files = Vec::new();
        for (number, lines) in lists.iter().enumerate() {
            std::fs::write(folder.path().join(number.to_string()), lines.join("\n") + "\n").unwrap();
            for (end, _) in ENDS {
                let phases = if end == "load" {
                    "#demo-simulator: download=20\n"
                } else {
                    ""
                };
                files.push((
                    format!("worlds/{end}-{number}.wbt"),
                    format!("#VRML_SIM R2025a utf8\n{phases}"),
                ));
            }
        }
        let files: Vec<_> = files
            .iter()
            .map(|(name, text)| (name.as_str(), text.as_str()))
            .collect();
        forge.commit("lab/printer", "main", &files);
        let webots = printer(folder.path());
        let builder = simulation_server(&webots.path(), forge.path(), 8)
            .set("isolation", "none")
            .set("limits.output", 100_000);
        Self {
            server: builder.start().await,
            folder,
            _forge: forge,
            _webots: webots,
        }
    }

    /// Runs a world to its end.
    async fn run(&self, end: &str, number: usize) -> Transcript {
        let name = format!("{end}-{number}");
        let url = world("lab/printer", "main", &format!("worlds/{name}.wbt"));
        let mut client = Client::start(&self.server, &url).await;
        match end {
            "launch" => {}
            "load" => drop(client.until("loading: Webots: Downloading").await),
            _ => drop(client.until("webots:").await),
        }
        std::fs::write(self.folder.path().join(&name), "").unwrap();
        if end == "run" {
            // Its output is read before its heartbeat.
            client.until(".").await;
            let texts = client.heard.clone();
            client.close_with(1000).await;
            return Transcript { texts, code: None };
        }
        let code = client.closed().await;
        Transcript {
            texts: client.heard,
            code,
        }
    }

    /// The counters of starts and ends, and the failures that count against the server.
    async fn counted(&self) -> BTreeMap<String, String> {
        let ended = async || self.server.simulations().await.is_empty();
        until("all simulations have ended", ended).await;
        let metrics = self.server.metrics().await;
        let counters = metrics.lines().filter_map(|line| line.split_once(' '));
        counters
            .filter(|(name, _)| name.contains("reason=") || name.contains("outcome=") || name.contains("failed"))
            .map(|(name, value)| (name.to_owned(), value.to_owned()))
            .collect()
    }
}

/// What the viewer page does with each of these.
fn replayed(transcripts: &[&[String]]) -> Vec<Value> {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(&serde_json::to_vec(transcripts).unwrap()).unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/assets/replay.js");
    let output = std::process::Command::new("node")
        .arg(script)
        .arg(file.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[actix_rt::test]
async fn nothing_depends_on_what_a_simulation_prints() {
    needs!("node");
    let hostile = lists();
    let neutral = hostile
        .iter()
        .map(|lines| vec![NEUTRAL.to_owned(); lines.len()])
        .collect::<Vec<_>>();
    let stages = [Stage::with(&neutral).await, Stage::with(&hostile).await];
    let mut runs = Vec::new();
    for (end, code) in ENDS {
        for first in (0..hostile.len()).step_by(8) {
            let numbers = first..hostile.len().min(first + 8);
            let of = |stage| {
                futures_util::future::join_all(numbers.clone().map(move |number| Stage::run(stage, end, number)))
            };
            let [neutral, hostile] = [of(&stages[0]).await, of(&stages[1]).await];
            for (neutral, hostile) in neutral.into_iter().zip(hostile) {
                assert_eq!(neutral.meaning(), hostile.meaning(), "{end}: {:#?}", hostile.texts);
                let is_meant = |text: &String| text.contains(&format!("\"code\":\"{code}\""));
                assert!(
                    end == "run" || hostile.texts.iter().any(is_meant),
                    "{end}: {:#?}",
                    hostile.texts
                );
                runs.push((neutral.to_replay(), hostile.to_replay()));
            }
        }
    }
    assert_eq!(stages[0].counted().await, stages[1].counted().await);
    let pages = replayed(
        &runs
            .iter()
            .flat_map(|(neutral, hostile)| [&neutral[..], &hostile[..]])
            .collect::<Vec<_>>(),
    );
    for (pair, (_, texts)) in pages.chunks(2).zip(&runs) {
        assert_eq!(pair[0], pair[1], "{texts:#?}");
    }
}

#[actix_rt::test]
async fn the_page_depends_on_no_text_that_a_project_prints() {
    needs!("node");
    let stage = Stage::with(&[vec![NEUTRAL.to_owned()]]).await;
    let mut transcripts = Vec::new();
    for (end, _) in ENDS {
        let texts = stage.run(end, 0).await.texts;
        for printed in std::iter::once(NEUTRAL.to_owned()).chain(sentences::all()) {
            // In JSON as in a plain text.
            let quoted = json!(printed).to_string();
            let quoted = &quoted[1..quoted.len() - 1];
            let put = |text: &String| {
                let printed = if text.starts_with("reason:") { quoted } else { &printed };
                text.replace(NEUTRAL, printed).replace("Downloading assets", printed)
            };
            transcripts.push(texts.iter().map(put).collect::<Vec<_>>());
        }
    }
    let pages = replayed(&transcripts.iter().map(Vec::as_slice).collect::<Vec<_>>());
    let of_each = pages.len() / ENDS.len();
    for (pages, transcripts) in pages.chunks(of_each).zip(transcripts.chunks(of_each)) {
        for (page, texts) in pages.iter().zip(transcripts) {
            assert_eq!(page, &pages[0], "{texts:#?}");
        }
    }
}

#[actix_rt::test]
async fn nothing_depends_on_the_names_in_a_repository() {
    let forge = Forge::new();
    let webots = reader();
    let text = world_text("a");
    let long = "x".repeat(260);
    let in_name = |sentence: &String| {
        let letters = sentence.chars();
        let fitting = letters.filter(|letter| !"/\"\\".contains(*letter) && !letter.is_control());
        let name: String = fitting.collect();
        format!("\"worlds/{}{long}\"", name.trim_matches('.'))
    };
    // No file system takes names as long as these: git prints them. The cause of the failure is the first one alone, as far
    // as the server reads a line.
    let all = sentences::all();
    let others: Vec<String> = sentences::of_others().collect();
    let mut lists: Vec<Vec<String>> = all.chunks(200).map(<[String]>::to_vec).collect();
    lists.extend(others.chunks(10).map(|some| vec![some.join(" ")]));
    for (number, list) in lists.iter().enumerate() {
        let names: Vec<String> = list.iter().map(in_name).collect();
        let mut files = vec![("worlds/a.wbt", text.as_str())];
        files.extend(names.iter().map(|name| (name.as_str(), "")));
        forge.commit(&format!("lab/long{number}"), "main", &files);
    }
    let server = simulation_server(&webots.path(), forge.path(), 8).start().await;
    for number in 0..lists.len() {
        let mut client = Client::start(&server, &world(&format!("lab/long{number}"), "main", "worlds/a.wbt")).await;
        client.until("loading: Error:").await;
        assert_eq!(client.reason()["code"], "invalid-project", "{:#?}", client.heard);
        assert_eq!(client.closed().await, Some(1000));
    }
    assert_eq!(server.status().await["failedStarts"], 0);
}
