//! What this server changes in a Dockerfile, and what it refuses. Pure.

use std::collections::HashMap;
use std::fmt::Write as _;

use crate::shared::text::excerpt;

/// The label of everything that this server has built, also of leftovers of failed builds.
pub const LABEL: &str = "webots-fleet.owner";
/// Why a Dockerfile can't have a volume, as the end of a sentence.
pub const NO_VOLUME: &str = "a volume would take the machine's disk without a limit; what a program writes has its place in the \
    project or in /tmp";
/// Why a Dockerfile can't have a here-document, as the end of a sentence.
const NO_HERE_DOCUMENT: &str = "RUN, ADD and COPY can't have `<<`: the builder used here knows no here-documents";
/// Longest excerpt of a line in an error, in characters.
const SHOWN: usize = 100;

/// Labels every stage of a Dockerfile with its owner.
///
/// # Errors
/// When it makes the daemon fetch something, which would use the machine's own network; when it has a volume; or when
/// it is ambiguous. As text for the client, with the line.
pub fn labelled(text: &str, owner: &str) -> Result<String, String> {
    let (mut labelled, mut instruction, mut first) = (String::new(), String::new(), 1);
    for (number, line) in (1..).zip(text.trim_start_matches('\u{feff}').lines()) {
        labelled.push_str(line);
        labelled.push('\n');
        let words = line.trim();
        if words.is_empty() || words.starts_with('#') {
            check_directive(words)?;
            continue;
        }
        if instruction.is_empty() {
            first = number;
        }
        let continued = continued(line).map_err(|why| wrong(number, line, why))?;
        instruction.push_str(continued.unwrap_or(line));
        if continued.is_some() {
            continue;
        }
        check(&instruction).map_err(|why| wrong(first, &instruction, why))?;
        if keyword(&instruction) == "FROM" {
            // Writing to a string can't fail.
            writeln!(labelled, "LABEL {LABEL}={owner}").ok();
        }
        instruction.clear();
    }
    check(&instruction).map_err(|why| wrong(first, &instruction, why)).map(|()| labelled)
}

fn wrong(number: usize, line: &str, why: &str) -> String {
    format!("The Dockerfile of this project can't be used, line {number}, `{}`: {why}", excerpt(line.trim(), SHOWN))
}

/// Refuses a comment that changes how the lines below are parsed.
fn check_directive(comment: &str) -> Result<(), String> {
    let directive = comment.trim_start_matches('#').trim().to_lowercase();
    let escape = directive.strip_prefix("escape").and_then(|rest| rest.trim_start().strip_prefix('='));
    match escape {
        Some(value) if value.trim() != "\\" => {
            Err("The Dockerfile of this project has another escape character than \\, which is not read here"
                .to_owned())
        }
        _ => Ok(()),
    }
}

/// The part of a line before the backslash that continues it in the next line.
fn continued(line: &str) -> Result<Option<&str>, &'static str> {
    let Some(before) = line.trim_end().strip_suffix('\\') else { return Ok(None) };
    let after = line.get(before.len() + 1..).unwrap_or_default();
    // Some versions of Docker continue such a line, others don't.
    if before.ends_with('\\') || after.contains(|letter: char| !" \t".contains(letter)) {
        return Err("a line ends with one backslash or none");
    }
    Ok(Some(before))
}

/// The base images of the stages of a Dockerfile, given its arguments as `NAME=value`. An image that depends on a
/// variable that is unknown here is left out.
#[must_use]
pub fn bases(text: &str, arguments: &[String]) -> Vec<String> {
    let given = arguments.iter().filter_map(|argument| argument.split_once('='));
    let given: HashMap<&str, &str> = given.collect();
    let (mut variables, mut stages, mut bases) = (HashMap::new(), vec!["scratch".to_owned()], Vec::new());
    let text = text.replace("\\\n", " ");
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match (keyword(line).as_str(), words.get(1..).unwrap_or_default()) {
            ("ARG", declared) if stages.len() == 1 => variables.extend(declared.iter().map(|variable| {
                let (name, default) = variable.split_once('=').unwrap_or((variable, ""));
                (name, *given.get(name).unwrap_or(&default.trim_matches('"')))
            })),
            ("FROM", rest) => {
                let mut rest = rest.iter().filter(|word| !word.starts_with("--"));
                let image = rest.next().map(|image| resolved(image, &variables)).unwrap_or_default();
                let is_known = stages.contains(&image.to_lowercase()) || bases.contains(&image);
                // Each stage has a name, or a number, which no image has.
                stages.push(rest.nth(1).map(|name| name.to_lowercase()).unwrap_or_default());
                if !is_known && !image.is_empty() && !image.contains('$') {
                    bases.push(image);
                }
            }
            _ => {}
        }
    }
    bases
}

/// A word of a Dockerfile with the values of variables, as `$NAME` or `${NAME}`.
fn resolved(word: &str, variables: &HashMap<&str, &str>) -> String {
    let mut names: Vec<_> = variables.iter().collect();
    // The longest name wins if one is a prefix of another.
    names.sort_by_key(|(name, _)| std::cmp::Reverse(name.len()));
    names.into_iter().fold(word.to_owned(), |word, (name, value)| {
        word.replace(&format!("${{{name}}}"), value).replace(&format!("${name}"), value)
    })
}

fn keyword(instruction: &str) -> String {
    instruction.split_whitespace().next().unwrap_or_default().to_uppercase()
}

fn check(instruction: &str) -> Result<(), &'static str> {
    let words = instruction.split_whitespace();
    let mut words = words.skip_while(|word| word.to_uppercase() == "ONBUILD");
    match words.next().map(str::to_uppercase).as_deref() {
        // The classic builder's parser recognizes them, though, and may take other lines for instructions than this
        // check does.
        Some("RUN" | "ADD" | "COPY") if instruction.contains("<<") => return Err(NO_HERE_DOCUMENT),
        Some("VOLUME") => return Err(NO_VOLUME),
        Some("ADD") => {}
        _ => return Ok(()),
    }
    let mut words: Vec<&str> = words.skip_while(|word| word.starts_with("--")).collect();
    if !words.first().is_some_and(|word| word.starts_with('[')) {
        // The destination.
        words.pop();
    }
    // A URL contains a colon, which a variable or an escape may hide.
    if words.iter().any(|word| word.contains([':', '$', '\\'])) {
        return Err("ADD may copy files of the project only, named without variables; RUN can fetch others");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_stage_is_labelled() {
        let text = "# a comment\nARG IMAGE\nfrom $IMAGE \\\n  as base\nRUN a \\\n  # inside\n  FROM b\nFROM scratch";
        let expected = "# a comment\nARG IMAGE\nfrom $IMAGE \\\n  as base\nLABEL webots-fleet.owner=x\nRUN a \\\n  # inside\n  \
                        FROM b\nFROM scratch\nLABEL webots-fleet.owner=x\n";
        assert_eq!(labelled(text, "x").unwrap(), expected);
    }

    #[test]
    fn the_images_that_a_dockerfile_begins_with_are_known() {
        let arguments = ["WEBOTS_DEFAULT_IMAGE=webots:1".to_owned(), "MAKE=1".to_owned()];
        for (text, expected) in [
            ("FROM a:1\nRUN x\n", &["a:1"][..]),
            ("ARG WEBOTS_DEFAULT_IMAGE\nfrom \\\n  ${WEBOTS_DEFAULT_IMAGE} AS Base\nFROM base\n", &["webots:1"]),
            ("ARG TAG=\"2\"\nFROM --platform=linux/amd64 b:$TAG as x\nFROM scratch\nFROM c\nFROM c\n", &["b:2", "c"]),
            ("FROM a\nARG IMAGE=b\nFROM $IMAGE\n", &["a"]),
            ("ARG WEBOTS_DEFAULT_IMAGE=x\nFROM $WEBOTS_DEFAULT_IMAGE\n", &["webots:1"]),
            ("no Dockerfile\n", &[]),
        ] {
            assert_eq!(bases(text, &arguments), expected, "{text}");
        }
    }

    #[test]
    fn what_the_daemon_would_fetch_or_keep_is_refused_with_its_line() {
        let told = labelled("FROM a\n# VOLUME /x\n\nRUN b \\\n c\nADD \\\n http://a /x\n", "x").unwrap_err();
        assert!(told.contains("line 6, `ADD") && told.contains("`: ADD may copy files of the project only"), "{told}");
        let hidden = "FROM debian\nRUN <<'#x'\ny \\\n#x\nADD http://169.254.169.254/latest/ /leak\n";
        let told = labelled(hidden, "x").unwrap_err();
        assert!(told.contains("line 2, `RUN <<'#x'`: RUN, ADD and COPY can't have `<<`"), "{told}");
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
            "VOLUME /data",
            "volume \\\n /data",
            "ONBUILD VOLUME /data",
        ] {
            assert!(labelled(&format!("FROM a\n{line}\n"), "x").is_err(), "{line}");
        }
        assert!(labelled("# escape = `\nFROM a\nRUN b \\\nADD http://a /x\n", "x").is_err());
        assert!(labelled("\u{feff}#ESCAPE=`\nFROM a\nRUN b \\\nADD http://a /x\n", "x").is_err());
        assert!(labelled("# escape=\\\nFROM a\n", "x").is_ok());
        for line in [
            "ADD a.tar.gz /x",
            "RUN wget http://a/b",
            "COPY . $PROJECT_PATH",
            "RUN add $x",
            "ADD --chown=1:1 . $PROJECT_PATH",
            "RUN a \\ \t\n b",
        ] {
            assert!(labelled(&format!("FROM a\n{line}\n"), "x").is_ok(), "{line}");
        }
    }
}
