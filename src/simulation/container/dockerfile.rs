//! What this server changes in a Dockerfile, and what it refuses. Pure.

use std::fmt::Write as _;

use crate::shared::text::excerpt;

/// A Dockerfile that this server builds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dockerfile {
    /// Its text, in which every stage has the label of its owner, and the last one makes the home of its user readable.
    pub text: String,
    /// The base images of its stages, as written after each `FROM`.
    pub bases: Vec<String>,
}

/// The label of everything that this server has built, also of leftovers of failed builds.
pub const LABEL: &str = "webots-fleet.owner";
/// The last instruction: lets the server's user read the home of the image's own user, such as the assets and settings
/// of Webots in `/root`. It changes only the modes that it must, because each changed file is copied into a layer. It
/// fails only for root, because other users can't change the modes of all files.
const OPEN_HOME: &str = concat!(
    r#"RUN ["/bin/sh","-c","[ ! -d \"$HOME\" ] || [ \"$HOME\" = / ] || find \"$HOME\" -xdev "#,
    r#"\\( -type d ! -perm -5 -o -type f ! -perm -4 \\) -exec chmod a+rX {} + || [ $(id -u) != 0 ]"]"#,
    "\n"
);
/// Why a Dockerfile can't have a volume, as the end of a sentence.
pub const NO_VOLUME: &str = "a volume would take the machine's disk without a limit; what a program writes has its place in the \
    project or in /tmp";
/// Why a Dockerfile can't have a here-document, as the end of a sentence.
const NO_HERE_DOCUMENT: &str = "RUN, ADD and COPY can't have `<<`: the builder used here knows no here-documents";
/// Why a Dockerfile can't fetch a URL with `ADD`, as the end of a sentence. The daemon would do it, from the machine's own
/// network.
const NO_URL: &str = "ADD may copy files of the project only, named without variables; RUN can fetch others";
/// Longest excerpt of a line in an error, in characters.
const MAX_EXCERPT: usize = 100;

impl Dockerfile {
    /// Reads the text of a Dockerfile.
    ///
    /// # Errors
    /// When it makes the daemon fetch something, which would use the machine's own network; when it has a volume; or when
    /// it is ambiguous. As text for the client, with the line.
    pub fn read(text: &str, owner: &str) -> Result<Self, String> {
        let mut found = Self {
            text: String::new(),
            bases: Vec::new(),
        };
        let mut instruction = String::new();
        let mut first = 1;
        for (number, line) in (1..).zip(text.trim_start_matches('\u{feff}').lines()) {
            found.text.push_str(line);
            found.text.push('\n');
            let words = line.trim();
            if words.is_empty() || words.starts_with('#') {
                // This directive would change the line continuation character from backslash to backtick.
                let comment = words.trim_start_matches('#').trim_start().to_lowercase();
                if comment.starts_with("escape") && comment.contains('`') {
                    return Err(wrong(number, line, "the escape character has to be \\"));
                }
                continue;
            }
            if instruction.is_empty() {
                first = number;
            }
            let whole = line.trim_end_matches([' ', '\t']);
            let continued = whole.strip_suffix('\\');
            // Some versions of Docker continue such a line, others don't.
            let is_unclear = continued.map_or(words.ends_with('\\'), |before| before.ends_with('\\'));
            if is_unclear || line.contains('\r') {
                return Err(wrong(
                    number,
                    line,
                    "a line ends with one backslash or none, and a line break",
                ));
            }
            instruction.push_str(continued.unwrap_or(line));
            if continued.is_none() {
                found
                    .take(&instruction, owner)
                    .map_err(|why| wrong(first, &instruction, why))?;
                instruction.clear();
            }
        }
        if !instruction.is_empty() {
            return Err(wrong(first, &instruction, "the file ends within it"));
        }
        found.text.push_str(OPEN_HOME);
        // This overrides a label of the project. Writing to a string can't fail.
        writeln!(found.text, "LABEL {LABEL}={owner}").ok();
        Ok(found)
    }

    /// Checks an instruction, and labels a stage that begins with it.
    fn take(&mut self, instruction: &str, owner: &str) -> Result<(), &'static str> {
        let mut words = instruction
            .split_whitespace()
            .skip_while(|word| word.eq_ignore_ascii_case("ONBUILD"));
        let keyword = words.next().unwrap_or_default().to_uppercase();
        let mut words: Vec<&str> = words.skip_while(|word| word.starts_with("--")).collect();
        match keyword.as_str() {
            // The classic builder's parser recognizes here-documents all the same, and may take other lines for
            // instructions than this check does.
            "RUN" | "ADD" | "COPY" if instruction.contains("<<") => return Err(NO_HERE_DOCUMENT),
            "VOLUME" => return Err(NO_VOLUME),
            "ADD" => {
                if !words.first().is_some_and(|word| word.starts_with('[')) {
                    // The destination.
                    words.pop();
                }
                // A URL contains a colon, which a variable or an escape may hide.
                if words.iter().any(|word| word.contains([':', '$', '\\'])) {
                    return Err(NO_URL);
                }
            }
            "FROM" => {
                // Writing to a string can't fail.
                writeln!(self.text, "LABEL {LABEL}={owner}").ok();
                self.bases.extend(words.first().map(|image| (*image).to_owned()));
            }
            _ => {}
        }
        Ok(())
    }
}

fn wrong(number: usize, line: &str, why: &str) -> String {
    let line = excerpt(line.trim(), MAX_EXCERPT);
    format!("The Dockerfile of this project can't be used, line {number}, `{line}`: {why}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labelled(text: &str) -> Result<String, String> {
        Dockerfile::read(text, "x").map(|found| found.text)
    }

    #[test]
    fn every_stage_is_labelled() {
        let text = "# a comment\nARG IMAGE\nfrom $IMAGE \\\n  as base\nRUN a \\\n  # inside\n  FROM b\nFROM scratch";
        let expected = "# a comment\nARG IMAGE\nfrom $IMAGE \\\n  as base\nLABEL webots-fleet.owner=x\nRUN a \\\n  # inside\n  \
                        FROM b\nFROM scratch\nLABEL webots-fleet.owner=x\n";
        let found = Dockerfile::read(text, "x").unwrap();
        // The last label wins, so the project can't override it.
        let end = format!("{OPEN_HOME}LABEL webots-fleet.owner=x\n");
        assert_eq!(
            (found.text.strip_suffix(end.as_str()), found.bases),
            (Some(expected), vec!["$IMAGE".to_owned(), "scratch".to_owned()])
        );
    }

    #[test]
    fn what_the_daemon_would_fetch_or_keep_is_refused_with_its_line() {
        let told = labelled("FROM a\n# VOLUME /x\n\nRUN b \\\n c\nADD \\\n http://a /x\n").unwrap_err();
        assert!(
            told.contains("line 6, `ADD") && told.contains("`: ADD may copy files of the project only"),
            "{told}"
        );
        let hidden = "FROM debian\nRUN <<'#x'\ny \\\n#x\nADD http://169.254.169.254/latest/ /leak\n";
        let told = labelled(hidden).unwrap_err();
        assert!(
            told.contains("line 2, `RUN <<'#x'`: RUN, ADD and COPY can't have `<<`"),
            "{told}"
        );
        for line in [
            "COPY <<a <<b /x",
            "ADD --chown=1 <<-a /x",
            "onbuild run a \\\n <\\\n<a",
            "ADD http://169.254.169.254/latest /x",
            "add \\\n https://a/b /x",
            "ADD git@forge:lab/arm.git /x",
            "ADD $URL /x",
            "ONBUILD ADD http://a /x",
            "AD\\\nD http://a /x",
            "ON\\\nBUILD ADD http://a /x",
            "ADD http:/\\\n/a /x",
            "ADD http:/'/'a /x",
            r"ADD http:/\/a /x",
            r#"ADD ["http:\/\/a", "/x"]"#,
            r#"ADD ["http\u003a//a", "/x"]"#,
            "RUN a \\\\\nADD http://a /x",
            "RUN a \\\u{a0}\nADD http://a /x",
            "ADD \\\r\r\nhttp://a /x",
            "ADD \\\u{b}\nhttp://a /x",
            "ADD \\\rhttp://a /x",
            "VOLUME /data",
            "volume \\\n /data",
            "ONBUILD VOLUME /data",
            "RUN a \\",
        ] {
            assert!(labelled(&format!("FROM a\n{line}\n")).is_err(), "{line}");
        }
        assert!(labelled("# escape = `\nFROM a\nRUN b \\\nADD http://a /x\n").is_err());
        assert!(labelled("\u{feff}#ESCAPE=`\nFROM a\nRUN b \\\nADD http://a /x\n").is_err());
        assert!(labelled("# escape=\\\nFROM a\n").is_ok());
        for line in [
            "ADD a.tar.gz /x",
            "RUN wget http://a/b",
            "COPY . $PROJECT_PATH",
            "RUN add $x",
            "ADD --chown=1:1 . $PROJECT_PATH",
            "RUN a \\ \t\n b",
        ] {
            assert!(labelled(&format!("FROM a\n{line}\n")).is_ok(), "{line}");
        }
    }
}
