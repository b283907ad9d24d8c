//! What this server changes in a Dockerfile, and what it refuses. Pure.

use std::fmt::Write as _;

/// The label of all that this server has built, also of what a build that failed has left.
pub const LABEL: &str = "webots-fleet.owner";

/// Labels every stage of a Dockerfile with its owner.
///
/// # Errors
/// When it asks the daemon to fetch something, which would be done from the machine's own network. In words for the client.
pub fn labelled(text: &str, owner: &str) -> Result<String, String> {
    let mut labelled = String::new();
    let mut instruction = String::new();
    for line in text.lines() {
        labelled.push_str(line);
        labelled.push('\n');
        let words = line.trim();
        if words.is_empty() || words.starts_with('#') {
            continue;
        }
        let continued = words.strip_suffix('\\');
        instruction.push_str(continued.unwrap_or(words));
        instruction.push(' ');
        if continued.is_some() {
            continue;
        }
        check(&instruction)?;
        if keyword(&instruction) == "FROM" {
            // Writing to a text can't fail.
            writeln!(labelled, "LABEL {LABEL}={owner}").ok();
        }
        instruction.clear();
    }
    check(&instruction).map(|()| labelled)
}

fn keyword(instruction: &str) -> String {
    instruction.split_whitespace().next().unwrap_or_default().to_uppercase()
}

fn check(instruction: &str) -> Result<(), String> {
    let words = keyword(instruction);
    let added =
        if words == "ONBUILD" { keyword(instruction.trim().get(words.len()..).unwrap_or_default()) } else { words };
    let is_remote = instruction.contains("://") || instruction.contains("git@") || instruction.contains('$');
    if added == "ADD" && is_remote {
        return Err(format!(
            "The Dockerfile of this project has `{}`, but may ADD files of the project only; RUN can fetch others",
            instruction.trim()
        ));
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
    fn what_the_daemon_would_fetch_is_refused() {
        for line in [
            "ADD http://169.254.169.254/latest /x",
            "add \\\n https://a/b /x",
            "ADD git@forge:lab/arm.git /x",
            "ADD $URL /x",
            "ONBUILD ADD http://a /x",
        ] {
            assert!(labelled(&format!("FROM a\n{line}\n"), "x").is_err(), "{line}");
        }
        for line in ["ADD a.tar.gz /x", "RUN wget http://a/b", "COPY . $PROJECT_PATH", "RUN add $x"] {
            assert!(labelled(&format!("FROM a\n{line}\n"), "x").is_ok(), "{line}");
        }
    }
}
