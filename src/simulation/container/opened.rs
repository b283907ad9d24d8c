//! An image in which the server's user can read the home directory of the image's own user: assets and settings of
//! Webots.
//!
//! Simulations run as the server's user, so that the server can read, measure and remove what they write, and so that
//! no program in a directory of this machine ever runs as root. Official images of Webots keep assets and settings in
//! `/root`, which no other user may read. So a layer on top of an image opens it once.

use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::dockerfile::{LABEL, NO_VOLUME};
use super::owned_resources::digest;
use crate::shared::text::one_line;

/// The configuration of the programs that run in an image, as Docker tells it.
#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "PascalCase", default)]
pub struct ImageConfig {
    /// Its user, `root` if empty.
    user: String,
    /// The program that gets the command.
    entrypoint: Option<Vec<String>>,
    /// The command if none is given.
    cmd: Option<Vec<String>>,
    /// The directories of its volumes.
    volumes: Option<serde_json::Map<String, Value>>,
}

/// The first output of a container when it runs: from then on its network has an address.
pub const RUNS: &str = "webots-fleet: the container runs";
/// Programs that are added to the image: names and texts.
const PROGRAMS: [(&str, &str); 2] = [
    ("open-home", include_str!("../../../config/simulation/docker/open-home")),
    ("start-at-home", include_str!("../../../config/simulation/docker/start-at-home")),
];
/// Their directory in the image.
const FOLDER: &str = "/usr/local/share/webots-fleet";

impl ImageConfig {
    /// Parses what `docker image inspect` prints of it.
    ///
    /// # Errors
    /// When it can't be parsed, or the image has a volume; as text for the client.
    pub fn read(json: &str) -> Result<Self, String> {
        let config: Self = serde_json::from_str(json)
            .map_err(|error| format!("The configuration of the image can't be read: {error}"))?;
        match config.volumes.as_ref().and_then(|volumes| volumes.keys().next()) {
            Some(path) => Err(format!("The image that it begins with has `VOLUME {}`: {NO_VOLUME}", one_line(path))),
            None => Ok(config),
        }
    }

    /// The Dockerfile of the image on top of the one with this id.
    #[must_use]
    pub fn dockerfile(self, id: &str, owner: &str) -> String {
        let words = |words: &[String]| serde_json::json!(words).to_string();
        let open = words(&["/bin/sh".to_owned(), format!("{FOLDER}/open-home"), self.user]);
        let entrypoint = [vec![format!("{FOLDER}/start-at-home")], self.entrypoint.unwrap_or_default()].concat();
        // An entry point clears the command of the image below.
        let command = self.cmd.map_or_else(String::new, |command| format!("CMD {}\n", words(&command)));
        format!(
            "FROM {id}\nLABEL {LABEL}={owner}\nUSER root\nCOPY . {FOLDER}\nRUN {open}\nENTRYPOINT {}\n{command}",
            words(&entrypoint)
        )
    }
}

/// A tag for an opened image, a hash of all these parts.
#[must_use]
pub fn key(parts: &[String]) -> String {
    let parts: Vec<&str> = parts.iter().map(String::as_str).chain(PROGRAMS.map(|(_, program)| program)).collect();
    digest(parts.join("\0").as_bytes())
}

/// Writes the programs into a directory.
///
/// # Errors
/// When that can't be done.
pub fn write_programs(folder: &Path) -> io::Result<()> {
    std::fs::create_dir_all(folder)?;
    for (name, text) in PROGRAMS {
        let path = folder.join(name);
        std::fs::write(&path, text)?;
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755))?;
    }
    // The mode of the directory is copied into the image.
    std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o755))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_keeps_its_entry_point_and_command_as_data() {
        let told =
            r#"{"User":"x\n\"","Env":["A=b"],"Entrypoint":["/bin/sh","-c","a \\"],"Cmd":["b","\n"],"Volumes":null}"#;
        let text = ImageConfig::read(told).unwrap().dockerfile("sha256:1", "me");
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines,
            [
                "FROM sha256:1",
                "LABEL webots-fleet.owner=me",
                "USER root",
                "COPY . /usr/local/share/webots-fleet",
                r#"RUN ["/bin/sh","/usr/local/share/webots-fleet/open-home","x\n\""]"#,
                r#"ENTRYPOINT ["/usr/local/share/webots-fleet/start-at-home","/bin/sh","-c","a \\"]"#,
                r#"CMD ["b","\n"]"#,
            ]
        );
        let plain = ImageConfig::read("{}").unwrap().dockerfile("sha256:2", "me");
        assert!(plain.ends_with("ENTRYPOINT [\"/usr/local/share/webots-fleet/start-at-home\"]\n"));
    }

    #[test]
    fn an_image_that_keeps_data_is_refused() {
        let wrong = ImageConfig::read(r#"{"Volumes":{"/data":{}}}"#).unwrap_err();
        assert!(wrong.contains("`VOLUME /data`"), "{wrong}");
    }
}
