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

use std::io;
use std::path::{Path, PathBuf};

use crate::shared::text::excerpt;

/// The names of the file; the first one that exists counts.
const NAMES: [&str; 2] = ["webots.yml", "webots.yaml"];
/// Size limit of a file with which a project configures its containers, in bytes.
const MAX_SIZE: u64 = 256 * 1024;
/// Size limit of the line of the type, and of a directory, in bytes.
const MAX_LENGTH: usize = 200;
/// Longest excerpt of a value in a warning, in characters.
const MAX_EXCERPT: usize = 60;
/// The first component of each directory, which means the project.
const PROJECT: &str = "webots-project";
/// The parent of projects in a container. Some files contain it, as a path that goes up to the root first.
const ABOVE_PROJECT: &str = "usr/local/";

/// What runs beside Webots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ProjectKind {
    /// No other program.
    #[default]
    Default,
    /// An editor of a directory of the project.
    Editor,
    /// The controller of a participant, and an editor of its directory.
    Competition,
}

/// What a project requests.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct WebotsYml {
    /// What runs beside Webots.
    pub kind: ProjectKind,
    /// The directory of the editor, such as `webots-project/controllers/edit/`; empty without one.
    pub folder: String,
    /// The message to the web client with the simulation's type, such as `type:demo` and a line end: the line without its
    /// spaces, as the original sends it.
    pub project_type: Option<String>,
    /// The problems of the file, as text for its author, one line each.
    pub warnings: Vec<String>,
}

impl WebotsYml {
    /// Reads the file of a project; a project without one requests nothing. Blocks.
    pub fn read(project: &Path) -> Self {
        match NAMES.iter().find_map(|name| text_of(&project.join(name)).transpose()) {
            None => Self::default(),
            Some(Ok(text)) => Self::parse(&text),
            Some(Err(warning)) => Self {
                warnings: vec![warning],
                ..Self::default()
            },
        }
    }

    /// Parses the text of a file.
    pub fn parse(text: &str) -> Self {
        let text = text.trim_start_matches('\u{feff}');
        let mut found = Self::default();
        if let Some(value) = text
            .lines()
            .filter_map(|line| line.strip_prefix("dockerCompose:"))
            .next_back()
        {
            match request(value) {
                Some((kind, folder)) => (found.kind, found.folder) = (kind, folder),
                None => found.warnings.push(warning(value)),
            }
        }
        let line = text
            .lines()
            .map(str::trim)
            .find(|line| line.starts_with("type:"))
            .unwrap_or_default();
        let line: String = line
            .chars()
            .filter(|letter| *letter != ' ' && !letter.is_control())
            .collect();
        found.project_type = (1..=MAX_LENGTH).contains(&line.len()).then(|| line + "\n");
        found
    }

    /// The directory below the project's own, such as `controllers/edit`. It is not checked yet: it may be missing, or
    /// be a symlink to any path.
    pub fn folder_in_project(&self) -> PathBuf {
        Path::new(&self.folder).components().skip(1).collect()
    }
}

/// The text of a file of a project in which nothing runs yet; `None` if it does not exist. Anything but a regular file is
/// refused: a symlink could resolve to any path.
///
/// # Errors
/// Why it can't be read, as text for the client.
pub fn text_of(path: &Path) -> Result<Option<String>, String> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Ok(about) if about.is_file() && about.len() <= MAX_SIZE => {
            let text = std::fs::read_to_string(path);
            text.map(Some)
                .map_err(|error| format!("{name} of the project can't be read: {error}"))
        }
        _ => Err(format!(
            "{name} of the project is no plain file of at most {} KiB",
            MAX_SIZE / 1024
        )),
    }
}

/// What the value of `dockerCompose` requests, such as `theia:webots-project/controllers`; `None` if that is not
/// allowed.
fn request(value: &str) -> Option<(ProjectKind, String)> {
    let value = value.split_once(" #").map_or(value, |(value, _comment)| value).trim();
    let value = value.trim_matches(['"', '\'']);
    if value.is_empty() {
        return Some(Default::default());
    }
    let (kind, folder) = value.split_once(':')?;
    let kind = match kind.trim() {
        "competition" => ProjectKind::Competition,
        kind if kind.starts_with("theia") => ProjectKind::Editor,
        _ => return None,
    };
    let folder = folder.trim();
    let from_root = folder
        .trim_start_matches("../")
        .trim_start_matches('/')
        .strip_prefix(ABOVE_PROJECT);
    let folder = from_root.unwrap_or(folder);
    let is_plain = |letter: char| letter.is_alphanumeric() || " _-+./".contains(letter);
    let is_allowed = folder.len() <= MAX_LENGTH
        && folder.chars().all(is_plain)
        && folder.split('/').next() == Some(PROJECT)
        && !folder.split('/').any(|part| part == ".." || part == ".");
    is_allowed.then(|| (kind, folder.to_owned()))
}

fn warning(value: &str) -> String {
    format!(
        "dockerCompose in webots.yml is \"{}\": it may be theia:{PROJECT}/FOLDER for an editor or competition:{PROJECT}/FOLDER \
         for a competition, where FOLDER has letters, digits, spaces and _-+./ only, and no parts . and ..",
        excerpt(value.trim(), MAX_EXCERPT)
    )
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    const NOTHING: (ProjectKind, &str) = (ProjectKind::Default, "");

    fn editor(folder: &str) -> (ProjectKind, &str) {
        (ProjectKind::Editor, folder)
    }

    fn competition(folder: &str) -> (ProjectKind, &str) {
        (ProjectKind::Competition, folder)
    }

    #[test]
    fn what_projects_ask_for_is_read_in_every_form() {
        for (text, expected) in [
            ("", NOTHING),
            ("# a comment\n", NOTHING),
            ("publish: true\ntype: demo\n", NOTHING),
            ("dockerCompose:\npublish: true\n", NOTHING),
            (
                "publish: true\ntype: demo\ndockerCompose:theia:webots-project/controllers/",
                editor("webots-project/controllers/"),
            ),
            (
                "publish: true\ndockerCompose:theia:webots-project/a b\n",
                editor("webots-project/a b"),
            ),
            (
                "dockerCompose:theia:webots-project/\r\npublish: true\r\n",
                editor("webots-project/"),
            ),
            (
                "dockerCompose: theia:webots-project/x # ours\n",
                editor("webots-project/x"),
            ),
            (
                "dockerCompose: \"theia:webots-project/x\"\n",
                editor("webots-project/x"),
            ),
            (
                "dockerCompose: 'theia-python:webots-project/x'\n",
                editor("webots-project/x"),
            ),
            (
                "dockerCompose: theia:webots-project/x\ndockerCompose: theia:webots-project/y\n",
                editor("webots-project/y"),
            ),
            (
                "\u{feff}dockerCompose:theia:webots-project/x",
                editor("webots-project/x"),
            ),
            ("#dockerCompose:theia:webots-project/x\n", NOTHING),
            ("docker:\n  dockerCompose:theia:webots-project/x\n", NOTHING),
            (
                "publish: true\ntype: competition\nworld:\n  file: worlds/a.wbt\n  max-duration: 60\n  metric: time-speed\n  \
                 higher-is-better: true\ndockerCompose: competition:webots-project/controllers/participant/\n",
                competition("webots-project/controllers/participant/"),
            ),
            (
                "type: competition\ndockerCompose: competition:../../../usr/local/webots-project/controllers/participant/\n",
                competition("webots-project/controllers/participant/"),
            ),
            (
                "dockerCompose:theia:/usr/local/webots-project/x",
                editor("webots-project/x"),
            ),
        ] {
            let found = WebotsYml::parse(text);
            assert_eq!((found.kind, found.folder.as_str()), expected, "{text:?}");
            assert_eq!(found.warnings, [""; 0], "{text:?}");
        }
    }

    #[test]
    fn what_nobody_may_ask_for_is_warned_of() {
        let long = format!("theia:webots-project/{}", "x".repeat(MAX_LENGTH));
        for value in [
            "postgres:webots-project/x",
            "theia",
            "{theia: webots-project/x}",
            "theia:/etc",
            "theia:../../webots-project/x",
            "theia:../../../usr/local/webots/x",
            "theia:/usr/local/../local/webots-project/x",
            "theia:controllers/x",
            "'theia:'",
            "theia:webots-project/../x",
            "theia:webots-project/./x",
            "theia:webots-project/x:/etc",
            "theia:webots-project/$HOME",
            "theia:webots-project/a\0b",
            "theia:webots-project/a\rIMAGE=x",
            "theia:webots-project/\u{202e}x",
            &long,
        ] {
            let found = WebotsYml::parse(&format!("dockerCompose: {value}"));
            assert_eq!((found.kind, found.folder.as_str()), NOTHING, "{value:?}");
            assert_eq!(found.warnings, [warning(value)], "{value:?}");
        }
        assert!(warning(" postgres:x").starts_with("dockerCompose in webots.yml is \"postgres:x\": it may be theia:"));
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
        let long = WebotsYml::parse(&format!("type: {}", "x".repeat(MAX_LENGTH)));
        assert_eq!(long.project_type, None);
    }

    #[test]
    fn a_folder_lies_in_the_project() {
        for (folder, inside) in [
            ("webots-project/controllers//edit/", "controllers/edit"),
            ("webots-project/", ""),
            ("webots-project", ""),
        ] {
            let found = WebotsYml {
                folder: folder.to_owned(),
                ..WebotsYml::default()
            };
            assert_eq!(found.folder_in_project(), PathBuf::from(inside), "{folder}");
        }
    }

    #[test]
    fn only_a_regular_file_of_the_project_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let project = folder.path().join("project");
        let outside = folder.path().join("outside");
        std::fs::create_dir(&project).unwrap();
        std::fs::write(&outside, "type: secret").unwrap();
        let told = || WebotsYml::read(&project);
        assert_eq!(told(), WebotsYml::default());

        std::fs::write(project.join("webots.yaml"), "type: second").unwrap();
        assert_eq!(told().project_type.as_deref(), Some("type:second\n"));

        let file = project.join("webots.yml");
        let warned = || {
            let found = told();
            assert!(
                found.warnings[0].contains("webots.yml of the project"),
                "{:?}",
                found.warnings
            );
            assert_eq!(found.project_type, None);
            if file.is_dir() {
                std::fs::remove_dir(&file).unwrap();
            } else {
                std::fs::remove_file(&file).unwrap();
            }
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
