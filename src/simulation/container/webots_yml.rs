//! What a project asks for in its `webots.yml`, else `webots.yaml`.
//!
//! | asked for | for what |
//! |---|---|
//! | `dockerCompose: "theia:webots-project/controllers/edit"` | an editor of that folder beside Webots |
//! | `dockerCompose: "competition:webots-project/controllers/participant"` | a competition, whose participant's folder that is |
//! | `type: demo` | told to the web client |
//!
//! Real projects also write `dockerCompose:theia:webots-project/controllers/`, which is no key of YAML, beside keys that
//! are. So a file is read as YAML first, and line by line where that says nothing.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use nix::fcntl::OFlag;
use serde::Deserialize;
use serde::de::IgnoredAny;

use crate::shared::text::excerpt;

/// The names of the file, the first that is there counts.
const NAMES: [&str; 2] = ["webots.yml", "webots.yaml"];
/// What a file may have at most, in bytes. Real ones have a few hundred.
const SIZE: usize = 64 * 1024;
/// What a line of the type and a folder may have at most, in bytes.
const LENGTH: usize = 200;
/// What is shown of a value in a warning, in letters.
const SHOWN: usize = 60;
/// The first part of each folder: it stands for the project.
const PROJECT: &str = "webots-project";
/// Where projects lie in a container. Some write this out, as a path that leads up to the root first.
const ABOVE_PROJECT: &str = "usr/local/";
/// What may be asked for, in words.
const ALLOWED: &str =
    r#""theia:webots-project/FOLDER" for an editor or "competition:webots-project/FOLDER" for a competition"#;

/// What runs beside Webots.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Kind {
    /// Nothing.
    #[default]
    Default,
    /// An editor of a folder of the project.
    Editor {
        /// The folder, such as `webots-project/controllers/edit/`.
        folder: String,
    },
    /// The controller of a participant.
    Competition {
        /// The folder of the participant, such as `webots-project/controllers/participant/`.
        folder: String,
    },
}

impl Kind {
    /// The folder below the project's own, such as `controllers/edit`. It may be missing there, or be a link to anywhere:
    /// nobody has looked yet.
    #[must_use]
    pub fn folder_in_project(&self) -> Option<PathBuf> {
        let (Self::Editor { folder } | Self::Competition { folder }) = self else { return None };
        Some(Path::new(folder).components().skip(1).collect())
    }
}

/// What a project asks for.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct WebotsYml {
    /// What runs beside Webots.
    pub kind: Kind,
    /// The message to the web client with the simulation's type, such as `type:demo` and a line end: the line without its
    /// spaces, as the original sends it.
    pub project_type: Option<String>,
    /// What is wrong with the file, in words for its author, each in one line.
    pub warnings: Vec<String>,
}

/// The one key of the file that is read as YAML.
#[derive(Deserialize)]
struct Document {
    #[serde(rename = "dockerCompose")]
    docker_compose: Option<Value>,
}

/// The value of `dockerCompose`.
#[derive(Deserialize)]
#[serde(untagged)]
enum Value {
    /// `theia:webots-project/controllers/edit`
    Text(String),
    /// `{theia: webots-project/controllers/edit}`
    Map(BTreeMap<String, String>),
    /// Anything else.
    Other(IgnoredAny),
}

impl WebotsYml {
    /// Reads the file of a project; a project without one asks for nothing. Reads from disk: not for a thread that serves
    /// others. A file that is no regular one, leads out of the project or is too large is warned of, and not read.
    ///
    /// # Errors
    /// When the project's folder or the file can't be read.
    pub fn read(project: &Path) -> io::Result<Self> {
        let project = project.canonicalize()?;
        for name in NAMES {
            let path = project.join(name);
            match path.symlink_metadata() {
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                Err(error) => return Err(error),
                Ok(_) => return read_file(&project, &path, name),
            }
        }
        Ok(Self::default())
    }

    /// Reads the text of a file.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        if text.len() > SIZE {
            return Self::warning("webots.yml is larger than 64 KiB, and is not read".to_owned());
        }
        let text = text.trim_start_matches('\u{feff}');
        let mut found = Self::default();
        match asked(text).and_then(|asked| asked.map_or(Ok(Kind::Default), |(kind, folder)| known(&kind, &folder))) {
            Ok(kind) => found.kind = kind,
            Err(warning) => found.warnings.push(warning),
        }
        if let Some(line) = text.lines().map(str::trim).find(|line| line.starts_with("type:")) {
            let line: String = line.chars().filter(|letter| *letter != ' ' && !letter.is_control()).collect();
            if line.len() <= LENGTH {
                found.project_type = Some(line + "\n");
            } else {
                found.warnings.push(format!("the line of the type in webots.yml has more than {LENGTH} bytes"));
            }
        }
        found
    }

    fn warning(warning: String) -> Self {
        Self { warnings: vec![warning], ..Self::default() }
    }
}

fn read_file(project: &Path, path: &Path, name: &str) -> io::Result<WebotsYml> {
    let path = match path.canonicalize() {
        Ok(path) if path.starts_with(project) => path,
        Ok(_) => return Ok(WebotsYml::warning(format!("{name} is a link out of the project, and is not read"))),
        Err(_) => return Ok(WebotsYml::warning(format!("{name} is a link to nothing"))),
    };
    // Opening a FIFO would wait for its writer.
    let flags = (OFlag::O_NONBLOCK | OFlag::O_NOFOLLOW | OFlag::O_NOCTTY).bits();
    let not_regular = || Ok(WebotsYml::warning(format!("{name} is no regular file, and is not read")));
    if !path.symlink_metadata()?.is_file() {
        return not_regular();
    }
    let file = File::options().read(true).custom_flags(flags).open(&path)?;
    if !file.metadata()?.is_file() {
        return not_regular();
    }
    let mut bytes = Vec::new();
    file.take(SIZE as u64 + 1).read_to_end(&mut bytes)?;
    Ok(if bytes.len() > SIZE {
        WebotsYml::warning(format!("{name} is larger than 64 KiB, and is not read"))
    } else {
        WebotsYml::parse(&String::from_utf8_lossy(&bytes))
    })
}

/// The kind and the folder that are asked for, or what is wrong with the question.
fn asked(text: &str) -> Result<Option<(String, String)>, String> {
    let from_yaml = yaml(text);
    if let Ok(Some(value)) = from_yaml {
        return match value {
            Value::Text(text) => split(&text).map(Some),
            Value::Map(map) => match map.into_iter().collect::<Vec<_>>().as_slice() {
                [(kind, folder)] => Ok(Some((kind.clone(), folder.clone()))),
                _ => Err(format!("dockerCompose in webots.yml is a map of {ALLOWED}: one of them")),
            },
            Value::Other(_) => Err(format!("dockerCompose in webots.yml is no text: it may be {ALLOWED}")),
        };
    }
    let Some(value) = text.lines().find_map(|line| line.strip_prefix("dockerCompose:")) else { return Ok(None) };
    let value = value.split_once(" #").map_or(value, |(value, _comment)| value).trim();
    let quoted = |quote| value.strip_prefix(quote)?.strip_suffix(quote);
    match quoted('"').or_else(|| quoted('\'')).unwrap_or(value) {
        "" => from_yaml.map(|_| None),
        value => split(value).map(Some),
    }
}

/// What the file asks for as YAML, or why it is none.
fn yaml(text: &str) -> Result<Option<Value>, String> {
    // A file that is so small needs no more, and a reference to a part that refers to others may become very large.
    let options = serde_saphyr::options! {
        budget: serde_saphyr::budget! {
            max_events: 20_000,
            max_nodes: 20_000,
            max_depth: 30,
            flow_nesting_limit: 30,
            max_documents: 1,
            max_anchors: 20,
            max_aliases: 20,
            max_merge_keys: 20,
            max_recorded_anchor_events: 20_000,
            max_recorded_anchor_bytes: SIZE,
        },
        alias_limits: serde_saphyr::alias_limits! {
            max_total_replayed_events: 1_000,
            max_replay_stack_depth: 4,
        },
        with_snippet: false,
    };
    match serde_saphyr::from_str_with_options::<Document>(text, options) {
        Ok(document) => Ok(document.docker_compose),
        Err(error) => Err(excerpt(&format!("webots.yml is no YAML: {error}"), LENGTH)),
    }
}

/// Cuts `theia:webots-project/controllers` in two.
fn split(value: &str) -> Result<(String, String), String> {
    match value.split_once(':') {
        Some((kind, folder)) => Ok((kind.trim().to_owned(), folder.trim().to_owned())),
        None => Err(format!("dockerCompose in webots.yml is {}: it may be {ALLOWED}", shown(value))),
    }
}

fn known(kind: &str, folder: &str) -> Result<Kind, String> {
    let is_editor = kind.starts_with("theia");
    if !is_editor && kind != "competition" {
        return Err(format!("dockerCompose in webots.yml asks for {}: it may be {ALLOWED}", shown(kind)));
    }
    let wrong = |why: &str| {
        let shown = shown(folder);
        Err(format!("the folder {shown} of dockerCompose in webots.yml {why}; it is like {PROJECT}/controllers/edit"))
    };
    let from_root = folder.trim_start_matches("../").trim_start_matches('/').strip_prefix(ABOVE_PROJECT);
    let folder = from_root.unwrap_or(folder);
    let is_plain = |letter: char| letter.is_alphanumeric() || " _-+./".contains(letter);
    if folder.len() > LENGTH {
        return wrong("is too long");
    }
    if !folder.chars().all(is_plain) {
        return wrong("may have letters, digits, spaces and _-+./ only");
    }
    if folder.split('/').any(|part| part == ".." || part == ".") {
        return wrong("must not have the parts . and ..");
    }
    if folder.split('/').next() != Some(PROJECT) {
        return wrong("must begin with webots-project, which stands for the project");
    }
    let folder = folder.to_owned();
    Ok(if is_editor { Kind::Editor { folder } } else { Kind::Competition { folder } })
}

fn shown(value: &str) -> String {
    format!("\"{}\"", excerpt(value, SHOWN))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    fn editor(folder: &str) -> Kind {
        Kind::Editor { folder: folder.to_owned() }
    }

    fn competition(folder: &str) -> Kind {
        Kind::Competition { folder: folder.to_owned() }
    }

    #[test]
    fn what_projects_ask_for_is_read_in_every_form() {
        for (text, kind) in [
            ("", Kind::Default),
            ("# a comment\n", Kind::Default),
            ("publish: true\ntype: demo\n", Kind::Default),
            ("dockerCompose:\npublish: true\n", Kind::Default),
            ("dockerCompose:theia:webots-project/controllers/\n", editor("webots-project/controllers/")),
            ("publish: true\ndockerCompose:theia:webots-project/a b\n", editor("webots-project/a b")),
            ("dockerCompose:theia:webots-project/\r\npublish: true\r\n", editor("webots-project/")),
            ("dockerCompose: theia:webots-project/x # ours\n", editor("webots-project/x")),
            ("dockerCompose: \"theia:webots-project/x\"\n", editor("webots-project/x")),
            ("dockerCompose: 'theia-python:webots-project/x'\n", editor("webots-project/x")),
            ("dockerCompose: [\ndockerCompose: 'theia:webots-project/x'\n", Kind::Default),
            ("a: [\ndockerCompose: 'theia:webots-project/x' # ours\n", editor("webots-project/x")),
            ("\u{feff}dockerCompose:theia:webots-project/x", editor("webots-project/x")),
            ("type: competition\ndockerCompose:competition:webots-project/p/", competition("webots-project/p/")),
            ("dockerCompose:\n  competition: webots-project/p\n", competition("webots-project/p")),
            ("text: |\n  dockerCompose:theia:webots-project/x\n", Kind::Default),
            ("#dockerCompose:theia:webots-project/x\n", Kind::Default),
            ("a: &a webots-project/x\ndockerCompose: {theia: *a}\n", editor("webots-project/x")),
            (
                "publish: true\ntype: competition\nworld:\n  file: worlds/a.wbt\n  max-duration: 300\n\
                dockerCompose: competition:../../../usr/local/webots-project/controllers/\n",
                competition("webots-project/controllers/"),
            ),
            ("dockerCompose:theia:/usr/local/webots-project/x", editor("webots-project/x")),
        ] {
            assert_eq!(WebotsYml::parse(text).kind, kind, "{text:?}");
        }
    }

    #[test]
    fn what_nobody_may_ask_for_is_warned_of() {
        let long = format!("dockerCompose:theia:webots-project/{}", "x".repeat(LENGTH));
        for (text, warning) in [
            ("dockerCompose: postgres:webots-project/x", "\"postgres\": it may be \"theia:"),
            ("dockerCompose: theia", "\"theia\": it may be \"theia:"),
            ("dockerCompose: 12", "is no text"),
            ("dockerCompose: [theia]", "is no text"),
            ("dockerCompose: {theia: webots-project/x, competition: webots-project/x}", "one of them"),
            ("dockerCompose: {}", "one of them"),
            ("a: [\ndockerCompose:\n  theia: webots-project/x\n", "webots.yml is no YAML"),
            ("dockerCompose: theia:/etc", "must begin with webots-project"),
            ("dockerCompose: theia:../../webots-project/x", "must not have the parts"),
            ("dockerCompose: theia:../../../usr/local/webots/x", "must begin with webots-project"),
            ("dockerCompose: theia:/usr/local/../local/webots-project/x", "must not have the parts"),
            ("dockerCompose: theia:controllers/x", "must begin with webots-project"),
            ("dockerCompose: 'theia:'", "must begin with webots-project"),
            ("dockerCompose: theia:webots-project/../x", "must not have the parts"),
            ("dockerCompose: theia:webots-project/./x", "must not have the parts"),
            ("dockerCompose: theia:webots-project/x:/etc", "letters, digits"),
            ("dockerCompose: theia:webots-project/$HOME", "letters, digits"),
            ("dockerCompose: \"theia:webots-project/a\\0b\"", "letters, digits"),
            ("dockerCompose: \"theia:webots-project/a\\nIMAGE=x\"", "letters, digits"),
            ("dockerCompose: theia:webots-project/\u{202e}x", "letters, digits"),
            (&long, "is too long"),
        ] {
            let found = WebotsYml::parse(text);
            assert_eq!(found.kind, Kind::Default, "{text:?}");
            assert_eq!(found.warnings.len(), 1, "{text:?}: {:?}", found.warnings);
            assert!(found.warnings[0].contains(warning), "{text:?}: {:?}", found.warnings);
        }
    }

    #[test]
    fn the_type_is_the_line_without_spaces() {
        for (text, message) in [
            ("type: demo\n", Some("type:demo\n")),
            ("simulation:\n  type:  my  demo # x", Some("type:mydemo#x\n")),
            ("types: demo\n", None),
            ("type: \u{1b}[2Jx\r\n", Some("type:[2Jx\n")),
        ] {
            assert_eq!(WebotsYml::parse(text).project_type.as_deref(), message, "{text:?}");
        }
        let long = WebotsYml::parse(&format!("type: {}", "x".repeat(LENGTH)));
        assert_eq!((long.project_type, long.warnings.len()), (None, 1));
    }

    #[test]
    fn a_folder_lies_in_the_project() {
        for (folder, inside) in
            [("webots-project/controllers//edit/", "controllers/edit"), ("webots-project/", ""), ("webots-project", "")]
        {
            assert_eq!(editor(folder).folder_in_project(), Some(PathBuf::from(inside)), "{folder}");
        }
        assert_eq!(Kind::Default.folder_in_project(), None);
    }

    #[test]
    fn references_of_references_take_neither_time_nor_memory() {
        let level = |level: usize| format!("a{level}: &a{level} [{}]\n", format!("*a{},", level - 1).repeat(9));
        let bomb = format!("a0: &a0 [x, x, x, x, x, x, x, x, x]\n{}", (1..15).map(level).collect::<String>());
        let began = std::time::Instant::now();
        let deep = "[".repeat(SIZE / 2);
        let wide = "- ".repeat(SIZE / 2);
        let merged = format!("dockerCompose: &m\n{}", "  <<: *m\n".repeat(5_000));
        for text in [&bomb, &format!("{bomb}dockerCompose: *a14"), &deep, &wide, &merged] {
            assert_eq!(WebotsYml::parse(text).kind, Kind::Default);
        }
        let line = format!("{bomb}dockerCompose: theia:webots-project/x\n");
        assert_eq!(WebotsYml::parse(&line).kind, editor("webots-project/x"));
        assert!(began.elapsed() < std::time::Duration::from_secs(5), "{:?}", began.elapsed());
    }

    #[test]
    fn only_a_regular_file_of_the_project_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let (project, outside) = (folder.path().join("project"), folder.path().join("outside"));
        std::fs::create_dir(&project).unwrap();
        std::fs::write(&outside, "type: secret").unwrap();
        let told = || WebotsYml::read(&project).unwrap();
        assert_eq!(told(), WebotsYml::default());

        std::fs::write(project.join("webots.yaml"), "type: second").unwrap();
        assert_eq!(told().project_type.as_deref(), Some("type:second\n"));

        let file = project.join("webots.yml");
        let warned = |warning: &str| {
            let found = told();
            assert!(found.warnings.iter().any(|told| told.contains(warning)), "{:?}", found.warnings);
            assert_eq!(found.project_type, None);
            if file.is_dir() { std::fs::remove_dir(&file).unwrap() } else { std::fs::remove_file(&file).unwrap() }
        };
        nix::unistd::mkfifo(&file, nix::sys::stat::Mode::S_IRWXU).unwrap();
        warned("no regular file");
        std::fs::create_dir(&file).unwrap();
        warned("no regular file");
        symlink("/dev/zero", &file).unwrap();
        warned("out of the project");
        symlink(&outside, &file).unwrap();
        warned("out of the project");
        symlink("nowhere", &file).unwrap();
        warned("link to nothing");
        std::fs::write(&file, "type: x\n".repeat(SIZE)).unwrap();
        warned("larger than 64 KiB");
        symlink("webots.yaml", &file).unwrap();
        assert_eq!(told().project_type.as_deref(), Some("type:second\n"));
    }
}
