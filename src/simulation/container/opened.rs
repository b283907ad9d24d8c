//! An image in which the server's user finds what the image's own user has at home: assets and settings of Webots.
//!
//! Simulations run as the server's user, so that what they write is the server's to show, measure and remove, and so that
//! no program in a folder of this machine is ever root's. Official images of Webots keep assets and settings in `/root`,
//! which no other user may read. So a layer on top of an image opens it once.

use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use super::dockerfile::{LABEL, NO_VOLUME};
use super::owned_resources::digest;
use crate::shared::text::one_line;

/// How programs run in an image.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct About {
    /// What tells the image from later ones of the same name.
    pub id: String,
    /// Its user, `root` if empty.
    user: String,
    /// The program that gets the command.
    entrypoint: Vec<String>,
    /// The command if none is given.
    command: Vec<String>,
}

/// How Docker is asked: a line each for the id, the user, and the words of the entry point and of the command.
pub const FORMAT: &str = "id {{json .Id}}{{println}}user {{json .Config.User}}{{println}}\
    {{range .Config.Entrypoint}}entrypoint {{json .}}{{println}}{{end}}\
    {{range .Config.Cmd}}command {{json .}}{{println}}{{end}}\
    {{range $path, $_ := .Config.Volumes}}volume {{json $path}}{{println}}{{end}}";
/// What the first program of a container prints when it runs: from then on its network has an address.
pub const RUNS: &str = "webots-fleet: the container runs";
/// Programs that the image gets: names and texts.
const PROGRAMS: [(&str, &str); 2] = [
    ("open-home", include_str!("../../../config/simulation/docker/open-home")),
    ("start-at-home", include_str!("../../../config/simulation/docker/start-at-home")),
];
/// Where they are in the image.
const FOLDER: &str = "/usr/local/share/webots-fleet";

impl About {
    /// Reads what Docker answers.
    ///
    /// # Errors
    /// When a word is too long for a line of the answer, or the image has a volume; in words for the client.
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
        // An entry point drops the command of the image below.
        let command = if command.is_empty() { String::new() } else { format!("CMD {}\n", words(command)) };
        format!(
            "FROM {id}\nLABEL {LABEL}={owner}\nUSER root\nCOPY . {FOLDER}\nRUN {open}\nENTRYPOINT {entrypoint}\n{command}"
        )
    }
}

/// A tag for an image that is opened, which all of these parts decide.
#[must_use]
pub fn key<'part>(parts: impl Iterator<Item = &'part str>) -> String {
    let parts: Vec<&str> = parts.chain(PROGRAMS.map(|(_, program)| program)).collect();
    format!("{:032x}", digest(parts.join("\0").as_bytes()))
}

/// Writes the programs into a folder.
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
    // The mode of the folder becomes that of the image's.
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
