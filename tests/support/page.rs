//! The commands and the files that a page of docs/ shows.

use std::path::Path;

/// A page by its name.
pub fn page(name: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs").join(name)).unwrap()
}

/// The text below a heading such as `## Kubernetes`.
pub fn section(page: &str, heading: &str) -> String {
    let (_, rest) = page
        .split_once(&format!("\n{heading}\n"))
        .unwrap_or_else(|| panic!("there is no {heading}"));
    rest.split("\n## ").next().unwrap().to_owned()
}

/// The code blocks of a page in this language, without the indentation of a surrounding list.
pub fn blocks(page: &str, language: &str) -> Vec<String> {
    let mut blocks = Vec::new();
    let mut inside = None;
    for line in page.lines() {
        let text = line.trim_start();
        inside = match (inside, text.strip_prefix("```")) {
            (None, Some(found)) => Some((found == language, line.len() - text.len(), String::new())),
            (Some((is_wanted, _, block)), Some(_)) => {
                blocks.extend(is_wanted.then_some(block));
                None
            }
            (Some((is_wanted, indentation, block)), None) => Some((
                is_wanted,
                indentation,
                block + line.get(indentation..).unwrap_or_default() + "\n",
            )),
            (None, None) => None,
        };
    }
    assert!(!blocks.is_empty(), "the page has no {language}");
    blocks
}

/// The lines of a page that are commands because they are indented.
pub fn commands(page: &str) -> Vec<String> {
    let mut is_block = false;
    let mut found = Vec::new();
    for line in page.lines() {
        is_block ^= line.starts_with("```");
        found.extend(line.strip_prefix("    ").filter(|_| !is_block).map(str::to_owned));
    }
    found
}
