//! Reading the project's own source: files, what of them ships, and what they import.

use std::collections::BTreeSet;

use super::copy::{root, walk};

/// A source file.
pub struct Source {
    /// Path below the project's folder.
    pub path: String,
    /// The text as it stands.
    pub text: String,
    /// Without comments and inline tests.
    pub shipped: String,
}

/// All files below `src`.
pub fn sources() -> Vec<Source> {
    let files = walk(&root().join("src")).into_iter().filter(|path| path.extension().is_some_and(|end| end == "rs"));
    files
        .map(|file| {
            let text = std::fs::read_to_string(&file).unwrap();
            let path = file.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
            let without_tests = without_tests(&text);
            let shipped = without_comments(&without_tests);
            Source { path, text, shipped }
        })
        .collect()
}

impl Source {
    /// The documentation of the file as a whole.
    pub fn purpose(&self) -> String {
        self.text.lines().map_while(|line| line.strip_prefix("//!")).collect::<Vec<_>>().join(" ")
    }

    /// The module that the file is, `simulation::webots`; programs are their own crates.
    pub fn module(&self) -> Option<String> {
        let inside = self.path.strip_prefix("src/")?.strip_suffix(".rs")?;
        let inside = inside.strip_suffix("/mod").unwrap_or(inside);
        (!inside.starts_with("bin/") && inside != "lib").then(|| inside.replace('/', "::"))
    }

    /// The modules of the library that the file names, each as the longest path that is one of `modules`.
    pub fn imports(&self, modules: &BTreeSet<String>) -> BTreeSet<String> {
        let own: Vec<String> = self.module().unwrap_or_default().split("::").map(str::to_owned).collect();
        let parent = &own[..own.len() - usize::from(!self.path.ends_with("/mod.rs"))];
        let resolved = paths(&self.shipped).into_iter().filter_map(|path| {
            let mut place = match path[0].as_str() {
                "super" => parent.to_vec(),
                _ => Vec::new(),
            };
            for name in &path[1..] {
                match name.as_str() {
                    "super" => drop(place.pop()),
                    name => place.push(name.to_owned()),
                }
            }
            (1..=place.len()).rev().map(|length| place[..length].join("::")).find(|name| modules.contains(name))
        });
        resolved.filter(|module| *module != own.join("::")).collect()
    }
}

/// A text up to its inline tests; whatever follows them still counts.
fn without_tests(text: &str) -> String {
    let Some((before, tests)) = text.split_once("#[cfg(test)]\nmod tests {") else {
        return text.to_owned();
    };
    let (_, after) = tests.split_once("\n}\n").unwrap();
    format!("{before}{after}")
}

fn without_comments(text: &str) -> String {
    text.lines().filter(|line| !line.trim_start().starts_with("//")).map(|line| format!("{line}\n")).collect()
}

/// Every path that begins with `crate`, `super` or the library's name; a group in braces is taken apart.
pub fn paths(text: &str) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    for root in ["crate::", "super::", "webots_fleet::"] {
        for (at, _) in text.match_indices(root) {
            let before = text[..at].chars().next_back().unwrap_or(' ');
            // Inside of an inline module, which is indented, super is the file itself.
            let indented = text[..at].ends_with(" use ") && root == "super::";
            if !before.is_alphanumeric() && before != '_' && before != ':' && !indented {
                let mut rest = &text[at..];
                group(&mut rest, &[], &mut found);
            }
        }
    }
    found
}

/// Reads one path, or the groups that it ends in, off the front of a text.
fn group(rest: &mut &str, before: &[String], found: &mut Vec<Vec<String>>) {
    let mut path = before.to_vec();
    loop {
        let end = rest.find(|letter: char| !letter.is_alphanumeric() && letter != '_').unwrap_or(rest.len());
        if end > 0 && &rest[..end] != "self" {
            path.push(rest[..end].to_owned());
        }
        *rest = &rest[end..];
        let Some(after) = rest.strip_prefix("::") else { break };
        *rest = after;
        if let Some(inside) = rest.strip_prefix('{') {
            *rest = inside;
            while !rest.starts_with('}') && !rest.is_empty() {
                *rest = rest.trim_start_matches(|letter: char| letter.is_whitespace() || letter == ',');
                if rest.starts_with('}') {
                    break;
                }
                let length = rest.len();
                group(rest, &path, found);
                if rest.len() == length {
                    *rest = &rest[1..];
                }
            }
            *rest = rest.strip_prefix('}').unwrap_or(rest);
            return;
        }
    }
    found.push(path);
}

#[test]
fn groups_of_imports_are_taken_apart() {
    let found = paths("use super::{a, b::{self, C}};\nuse crate::shared::x::Y;\nlet z = crate::q::f(super::r::G);\n");
    let joined: Vec<String> = found.iter().map(|path| path.join("::")).collect();
    assert_eq!(joined, ["crate::shared::x::Y", "crate::q::f", "super::a", "super::b", "super::b::C", "super::r::G"]);
}
