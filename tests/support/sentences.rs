//! All sentences of this project, out of its source, and those that git, Docker and the kernel usually print. A project
//! that prints them must not be taken for any of these.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use serde_json::json;
use webots_fleet::shared::domain::Reason;

/// Texts that mean something when git, Docker, a registry or a shell prints them.
const OF_OTHERS: [&str; 32] = [
    "Input-output error, Input output error",
    "Could not resolve host: github.com",
    "fatal: unable to access 'https://github.com/lab/arm/': Failed to connect to github.com port 443",
    "SSL certificate problem: unable to get local issuer certificate",
    "The requested URL returned error: 301",
    "fatal: repository 'https://github.com/lab/arm/' not found",
    "fatal: could not read Username for 'https://github.com': terminal prompts disabled",
    "remote: Repository not found.",
    "fatal: couldn't find remote ref main",
    "fatal: fetch-pack: invalid index-pack output",
    "fatal: early EOF",
    "error: Server does not allow request for unadvertised object 0123456789abcdef",
    "fatal: remote error: upload-pack: not our ref 0123456789abcdef",
    "fatal: write error: No space left on device",
    "fatal: Unable to create '/x/shallow.lock': File exists.",
    "bad object, corrupt, unable to read",
    "06:13:23.194170 http.c:913 <= Recv header: HTTP/1.1 404 Not Found",
    "06:13:23.194170 http.c:913 <= Recv header: location: https://github.com/lab/leg",
    "Cannot connect to the Docker daemon at unix:///var/run/docker.sock. Is the docker daemon running?",
    "error during connect: this error may indicate that the docker daemon is not running",
    "permission denied while trying to connect to the Docker daemon socket",
    "Error response from daemon: manifest unknown",
    "Error response from daemon: No such image: webots:latest",
    "Error response from daemon: pull access denied for webots, repository does not exist",
    "Error response from daemon: toomanyrequests: You have reached your pull rate limit",
    "OCI runtime create failed: container_linux.go:380: starting container process caused: exec: not found",
    "Step 1/1 : FROM nothing",
    "Step 8/9 : checking main out",
    "bwrap: Creating new namespace failed: Operation not permitted",
    "qt.qpa.xcb: could not connect to display :0",
    "out of memory: Killed process 1234 (webots-bin)",
    "Segmentation fault (core dumped)",
];

/// Each text with at least two words in the source of the servers, in scripts and templates of pages and mails, with the
/// values that are put into it; the protocol's texts of each reason; and those of others.
pub fn all() -> Vec<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut texts = BTreeSet::new();
    for folder in ["src", "templates"] {
        for path in files(&root.join(folder)) {
            let text = std::fs::read_to_string(&path).unwrap_or_default();
            match path.extension().and_then(|extension| extension.to_str()) {
                Some("rs") => texts.extend(literals(&text, &['"'])),
                Some("js") => texts.extend(literals(&text, &['\'', '"', '`'])),
                Some("html") => texts.extend(text.split(['<', '>']).map(str::to_owned)),
                _ => {}
            }
        }
    }
    let own = texts.len();
    assert!(own > 1000, "{own} texts are found");
    for known in [
        "This simulation server is stopping",
        "Webots has given no sign of life for 7 seconds",
    ] {
        assert!(texts.contains(known), "{known} is found");
    }
    for reason in Reason::ALL {
        let fields = json!({"code": reason, "blame": reason.blame(), "retry": reason.retry(), "message": "a b"});
        texts.extend([
            format!("reason: {fields}"),
            format!("loading: Error: {reason}"),
            format!("Error: {reason}"),
        ]);
    }
    texts.extend(
        [
            "queue: 0",
            "progress: {\"step\": \"launch\", \"text\": \"x\"}",
            "kind: w3d",
            "webots:ws://localhost:1",
            "resume: f00d",
            "watched: 1",
            "realTime: 0.6",
            "idle: 1",
        ]
        .map(str::to_owned),
    );
    texts.extend(of_others());
    let lines = texts.iter().flat_map(|text| text.lines()).map(str::trim);
    let has_words =
        |text: &&str| (4..400).contains(&text.len()) && text.contains(' ') && text.contains(char::is_alphabetic);
    let unique: BTreeSet<&str> = lines.filter(has_words).collect();
    unique.into_iter().map(str::to_owned).collect()
}

/// The texts of git, Docker, a registry, a shell and the kernel.
pub fn of_others() -> impl Iterator<Item = String> {
    let of_kernel = (1..134).map(|number| Errno::from_raw(number).desc());
    OF_OTHERS.into_iter().chain(of_kernel).map(str::to_owned)
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let files = entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] });
    files.collect()
}

/// The string literals of a source, with `7` for each value that is put into them.
fn literals(source: &str, quotes: &[char]) -> Vec<String> {
    let mut all = Vec::new();
    for line in joined(source).lines() {
        let line = line.trim_start();
        if line.starts_with("//") || line.starts_with('*') {
            continue;
        }
        // The literal that has begun: its quote and its text.
        let mut open: Option<(char, String)> = None;
        let mut letters = line.chars();
        while let Some(letter) = letters.next() {
            open = match open {
                Some((quote, text)) if letter == quote => {
                    all.push(filled(&text));
                    None
                }
                Some((quote, mut text)) => {
                    text.push(letter);
                    text.extend((letter == '\\').then(|| letters.next()).flatten());
                    Some((quote, text))
                }
                None => quotes.contains(&letter).then(|| (letter, String::new())),
            };
        }
    }
    all
}

/// Literals over several lines on one: `\` at the end of a line skips the beginning of the next.
fn joined(source: &str) -> String {
    let mut joined = String::new();
    let mut lines = source.lines();
    while let Some(line) = lines.next() {
        let mut line = line.to_owned();
        while let Some(before) = line.strip_suffix('\\') {
            line = format!("{before}{}", lines.next().unwrap_or_default().trim_start());
        }
        joined += &line;
        joined.push('\n');
    }
    joined
}

/// A literal as it is printed: `{name}` of Rust and `${name}` of JavaScript with a value.
fn filled(literal: &str) -> String {
    let literal = literal.replace("{{", "\u{1}").replace("}}", "\u{2}").replace("${", "{");
    let mut text = String::new();
    for (number, part) in literal.split('{').enumerate() {
        match part.split_once('}') {
            Some((_, after)) if number > 0 => {
                text.push('7');
                text.push_str(after);
            }
            _ => text.push_str(part),
        }
    }
    text.replace('\u{1}', "{")
        .replace('\u{2}', "}")
        .replace("\\n", " ")
        .replace('\\', "")
}
