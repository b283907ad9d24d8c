//! Webots' own viewer for browsers in the installation of Webots, and which of its files may be sent.

use std::path::{Component, Path, PathBuf};

use percent_encoding::percent_decode_str;

use crate::simulation::config::SimulationConfig;

/// Its directory below that of Webots.
const FOLDER: &str = "resources/web/wwi";
/// The viewer's main script.
const SCRIPT: &str = "WebotsView.js";
/// Its path on this server, as in `/status`.
pub const PATH: &str = "wwi/WebotsView.js";

/// The viewer's directory, if Webots is installed here.
pub fn folder(config: &SimulationConfig) -> Option<PathBuf> {
    let home = &config.webots_home.as_ref()?.0;
    Some(home.join(FOLDER)).filter(|folder| folder.join(SCRIPT).is_file())
}

/// A file below a directory; `None` if the path points outside it.
pub fn file_below(folder: &Path, path: &str) -> Option<PathBuf> {
    let path = percent_decode_str(path).decode_utf8().ok()?;
    let path = Path::new(path.as_ref());
    let is_below = path.components().all(|part| matches!(part, Component::Normal(_)));
    Some(folder.join(path)).filter(|file| is_below && file.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn nothing_outside_of_the_viewers_folder_is_sent() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("wwi");
        fs::create_dir_all(folder.join("css")).unwrap();
        for file in ["WebotsView.js", "css/wwi.css", "../secret.js"] {
            fs::write(folder.join(file), "").unwrap();
        }
        let table = [
            ("WebotsView.js", true),
            ("css/wwi.css", true),
            ("css%2Fwwi.css", true),
            ("css", false),
            ("", false),
            ("../secret.js", false),
            ("%2e%2e/secret.js", false),
            ("css/../../secret.js", false),
            ("/etc/passwd", false),
            ("WebotsView.js%00", false),
            ("%ff", false),
        ];
        for (path, found) in table {
            assert_eq!(file_below(&folder, path).is_some(), found, "{path:?}");
        }
    }
}
