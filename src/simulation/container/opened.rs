//! An image in which the server's user can read the home directory of the image's own user: assets and settings of
//! Webots.
//!
//! Simulations run as the server's user, so that the server can read, measure and remove what they write, and so that
//! no program in a directory of this machine ever runs as root. Official images of Webots keep assets and settings in
//! `/root`, which no other user may read. So a layer on top of an image opens it once.

use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use super::dockerfile::{LABEL, NO_VOLUME};
use super::owned_resources::digest;
use crate::shared::text::one_line;

/// The configuration of the programs that run in an image.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct About {
    /// The id of the image, which differs from those of later images of the same name.
    pub id: String,
    /// Its user, `root` if empty.
    user: String,
    /// The program that gets the command.
    entrypoint: Vec<String>,
    /// The command if none is given.
    command: Vec<String>,
}

/// The format for `docker image inspect`: one line each for the id, the user, the words of the entry point and of the
/// command, and the volumes.
pub const FORMAT: &str = "id {{json .Id}}{{println}}user {{json .Config.User}}{{println}}\
    {{range .Config.Entrypoint}}entrypoint {{json .}}{{println}}{{end}}\
    {{range .Config.Cmd}}command {{json .}}{{println}}{{end}}\
    {{range $path, $_ := .Config.Volumes}}volume {{json $path}}{{println}}{{end}}";
/// The first output of a container when it runs: from then on its network has an address.
pub const RUNS: &str = "webots-fleet: the container runs";
/// Programs that are added to the image: names and texts.
const PROGRAMS: [(&str, &str); 2] = [
    ("open-home", include_str!("../../../config/simulation/docker/open-home")),
    ("start-at-home", include_str!("../../../config/simulation/docker/start-at-home")),
];
/// Their directory in the image.
const FOLDER: &str = "/usr/local/share/webots-fleet";

impl About {
    /// Parses Docker's answer.
    ///
    /// # Errors
    /// When a line can't be parsed, or the image has a volume; as text for the client.
    pub fn read(answer: &str) -> Result<Self, String> {
        let unreadable = || "The image has an ENTRYPOINT, CMD or VOLUME that can't be read here".to_owned();
        let mut about = Self::default();
        for line in answer.lines() {
            let (name, word) = line.split_once(' ').ok_or_else(unreadable)?;
            let word: String = serde_json::from_str(word).map_err(|_| unreadable())?;
            match name {
                "id" => about.id = word,
                "user" => about.user = word,
                "entrypoint" => about.entrypoint.push(word),
                "command" => about.command.push(word),
                "volume" => {
                    return Err(format!("The image that it begins with has `VOLUME {}`: {NO_VOLUME}", one_line(&word)));
                }
                _ => return Err(unreadable()),
            }
        }
        if about.id.is_empty() { Err(unreadable()) } else { Ok(about) }
    }

    /// The Dockerfile of the image on top.
    #[must_use]
    pub fn dockerfile(&self, owner: &str) -> String {
        let words = |words: &[String]| serde_json::json!(words).to_string();
        let Self { id, user, entrypoint, command } = self;
        let open = words(&["/bin/sh".to_owned(), format!("{FOLDER}/open-home"), user.clone()]);
        let entrypoint = words(&[&[format!("{FOLDER}/start-at-home")], entrypoint.as_slice()].concat());
        // An entry point clears the command of the image below.
        let command = if command.is_empty() { String::new() } else { format!("CMD {}\n", words(command)) };
        format!(
            "FROM {id}\nLABEL {LABEL}={owner}\nUSER root\nCOPY . {FOLDER}\nRUN {open}\nENTRYPOINT {entrypoint}\n{command}"
        )
    }
}

/// A tag for an opened image, a hash of all these parts.
#[must_use]
pub fn key<'part>(parts: impl Iterator<Item = &'part str>) -> String {
    let parts: Vec<&str> = parts.chain(PROGRAMS.map(|(_, program)| program)).collect();
    format!("{:032x}", digest(parts.join("\0").as_bytes()))
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
        let told = "id \"sha256:1\"\nuser \"x\\n\\\"\"\nentrypoint \"/bin/sh\"\nentrypoint \"-c\"\nentrypoint \"a \\\\\"\n\
                    command \"b\"\ncommand \"\\n\"\n";
        let about = About::read(told).unwrap();
        let text = about.dockerfile("me");
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
        let plain = About::read("id \"sha256:2\"\nuser \"\"\n").unwrap();
        assert!(plain.dockerfile("me").ends_with("ENTRYPOINT [\"/usr/local/share/webots-fleet/start-at-home\"]\n"));
    }

    #[test]
    fn an_answer_that_was_cut_is_not_read() {
        assert!(About::read("id \"sha256:1\"\nuser \"\"\nentrypoint \"aaaa\n").is_err());
        assert!(About::read("").is_err());
    }

    #[test]
    fn an_image_that_keeps_data_is_refused() {
        let wrong = About::read("id \"sha256:1\"\nuser \"\"\nvolume \"/data\"\n").unwrap_err();
        assert!(wrong.contains("`VOLUME /data`"), "{wrong}");
    }
}
