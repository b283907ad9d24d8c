//! What a project requests in its `webots.yml`, else `webots.yaml`.
//!
//! | line | meaning |
//! |---|---|
//! | `dockerCompose: theia:webots-project/controllers/edit` | an editor of that directory beside Webots |
//! | `dockerCompose: competition:webots-project/controllers/participant` | a competition, with the participant's directory |
//! | `type: demo` | sent to the web client |
//!
//! It is parsed line by line, as in the original: existing files have lines that are not YAML, such as
//! `dockerCompose:theia:webots-project/controllers/`.

use std::path::{Path, PathBuf};

use super::project_file::text_of;
use crate::shared::text::excerpt;

/// The names of the file; the first one that exists counts.
const NAMES: [&str; 2] = ["webots.yml", "webots.yaml"];
/// Size limit of the line of the type, and of a directory, in bytes.
const LENGTH: usize = 200;
/// Longest excerpt of a value in a warning, in characters.
const SHOWN: usize = 60;
/// The first component of each directory, which means the project.
const PROJECT: &str = "webots-project";
/// The parent of projects in a container. Some files contain it, as a path that goes up to the root first.
const ABOVE_PROJECT: &str = "usr/local/";
/// What may be requested, as text.
const ALLOWED: &str =
    "theia:webots-project/FOLDER for an editor or competition:webots-project/FOLDER for a competition";

/// What runs beside Webots.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum ProjectKind {
    /// No other program.
    #[default]
    Default,
    /// An editor of a directory of the project.
    Editor {
        /// The directory, such as `webots-project/controllers/edit/`.
        folder: String,
    },
    /// The controller of a participant.
    Competition {
        /// The directory of the participant, such as `webots-project/controllers/participant/`.
        folder: String,
    },
}

impl ProjectKind {
    /// The directory below the project's own, such as `controllers/edit`. It is not checked yet: it may be missing, or
    /// be a symlink to any path.
    #[must_use]
    pub fn folder_in_project(&self) -> Option<PathBuf> {
        let (Self::Editor { folder } | Self::Competition { folder }) = self else { return None };
        Some(Path::new(folder).components().skip(1).collect())
    }
}

/// What a project requests.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct WebotsYml {
    /// What runs beside Webots.
    pub kind: ProjectKind,
    /// The message to the web client with the simulation's type, such as `type:demo` and a line end: the line without its
    /// spaces, as the original sends it.
    pub project_type: Option<String>,
    /// The problems of the file, as text for its author, one line each.
    pub warnings: Vec<String>,
}

impl WebotsYml {
    /// Reads the file of a project; a project without one requests nothing. Blocks.
    #[must_use]
    pub fn read(project: &Path) -> Self {
        for name in NAMES {
            match text_of(&project.join(name)) {
                Ok(None) => {}
                Ok(Some(text)) => return Self::parse(&text),
                Err(warning) => return Self { warnings: vec![warning], ..Self::default() },
            }
        }
        Self::default()
    }

    /// Parses the text of a file.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        let text = text.trim_start_matches('\u{feff}');
        let mut found = Self::default();
        let asked = text.lines().filter_map(|line| line.strip_prefix("dockerCompose:")).next_back();
        match asked.map_or(Ok(ProjectKind::Default), kind_of) {
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
}

/// The kind that the value of `dockerCompose` requests, such as `theia:webots-project/controllers`.
fn kind_of(value: &str) -> Result<ProjectKind, String> {
    let value = value.split_once(" #").map_or(value, |(value, _comment)| value).trim();
    let quoted = |quote| value.strip_prefix(quote)?.strip_suffix(quote);
    let value = quoted('"').or_else(|| quoted('\'')).unwrap_or(value);
    if value.is_empty() {
        return Ok(ProjectKind::Default);
    }
    let Some((kind, folder)) = value.split_once(':') else {
        return Err(format!("dockerCompose in webots.yml is {}: it may be {ALLOWED}", shown(value)));
    };
    let (kind, folder) = (kind.trim(), folder.trim());
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
    Ok(if is_editor { ProjectKind::Editor { folder } } else { ProjectKind::Competition { folder } })
}

fn shown(value: &str) -> String {
    format!("\"{}\"", excerpt(value, SHOWN))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    fn editor(folder: &str) -> ProjectKind {
        ProjectKind::Editor { folder: folder.to_owned() }
    }

    fn competition(folder: &str) -> ProjectKind {
        ProjectKind::Competition { folder: folder.to_owned() }
    }

    #[test]
    fn what_projects_ask_for_is_read_in_every_form() {
        for (text, kind) in [
            ("", ProjectKind::Default),
            ("# a comment\n", ProjectKind::Default),
            ("publish: true\ntype: demo\n", ProjectKind::Default),
            ("dockerCompose:\npublish: true\n", ProjectKind::Default),
            (
                "publish: true\ntype: demo\ndockerCompose:theia:webots-project/controllers/",
                editor("webots-project/controllers/"),
            ),
            ("publish: true\ndockerCompose:theia:webots-project/a b\n", editor("webots-project/a b")),
            ("dockerCompose:theia:webots-project/\r\npublish: true\r\n", editor("webots-project/")),
            ("dockerCompose: theia:webots-project/x # ours\n", editor("webots-project/x")),
            ("dockerCompose: \"theia:webots-project/x\"\n", editor("webots-project/x")),
            ("dockerCompose: 'theia-python:webots-project/x'\n", editor("webots-project/x")),
            (
                "dockerCompose: theia:webots-project/x\ndockerCompose: theia:webots-project/y\n",
                editor("webots-project/y"),
            ),
            ("\u{feff}dockerCompose:theia:webots-project/x", editor("webots-project/x")),
            ("#dockerCompose:theia:webots-project/x\n", ProjectKind::Default),
            ("docker:\n  dockerCompose:theia:webots-project/x\n", ProjectKind::Default),
            (
                "publish: true\ntype: competition\nworld:\n  file: worlds/a.wbt\n  max-duration: 60\n  metric: time-speed\n  \
                 higher-is-better: true\ndockerCompose: competition:webots-project/controllers/participant/\n",
                competition("webots-project/controllers/participant/"),
            ),
            (
                "type: competition\ndockerCompose: competition:../../../usr/local/webots-project/controllers/participant/\n",
                competition("webots-project/controllers/participant/"),
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
            ("dockerCompose: postgres:webots-project/x", "\"postgres\": it may be theia:"),
            ("dockerCompose: theia", "\"theia\": it may be theia:"),
            ("dockerCompose: {theia: webots-project/x}", "\"{theia\": it may be"),
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
            ("dockerCompose: theia:webots-project/a\0b", "letters, digits"),
            ("dockerCompose: theia:webots-project/a\rIMAGE=x", "letters, digits"),
            ("dockerCompose: theia:webots-project/\u{202e}x", "letters, digits"),
            (&long, "is too long"),
        ] {
            let found = WebotsYml::parse(text);
            assert_eq!(found.kind, ProjectKind::Default, "{text:?}");
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
        assert_eq!(ProjectKind::Default.folder_in_project(), None);
    }

    #[test]
    fn only_a_regular_file_of_the_project_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let (project, outside) = (folder.path().join("project"), folder.path().join("outside"));
        std::fs::create_dir(&project).unwrap();
        std::fs::write(&outside, "type: secret").unwrap();
        let told = || WebotsYml::read(&project);
        assert_eq!(told(), WebotsYml::default());

        std::fs::write(project.join("webots.yaml"), "type: second").unwrap();
        assert_eq!(told().project_type.as_deref(), Some("type:second\n"));

        let file = project.join("webots.yml");
        let warned = || {
            let found = told();
            assert!(found.warnings[0].contains("webots.yml of the project"), "{:?}", found.warnings);
            assert_eq!(found.project_type, None);
            if file.is_dir() { std::fs::remove_dir(&file).unwrap() } else { std::fs::remove_file(&file).unwrap() }
        };
        nix::unistd::mkfifo(&file, nix::sys::stat::Mode::S_IRWXU).unwrap();
        warned();
        std::fs::create_dir(&file).unwrap();
        warned();
        for target in [Path::new("/dev/zero"), outside.as_path(), Path::new("nowhere")] {
            symlink(target, &file).unwrap();
            warned();
        }
        std::fs::write(&file, "type: x\n".repeat(64 * 1024)).unwrap();
        warned();
        std::fs::write(&file, "type: first").unwrap();
        assert_eq!(told().project_type.as_deref(), Some("type:first\n"));
    }
}
