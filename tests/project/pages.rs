//! The documentation pages.

use std::collections::HashSet;
use std::path::PathBuf;

use super::copy::{root, walk};

fn pages() -> Vec<PathBuf> {
    let docs = walk(&root().join("docs"))
        .into_iter()
        .filter(|path| path.extension().is_some_and(|end| end == "md"));
    docs.chain(["README.md", "CHANGELOG.md", "CONTRIBUTING.md"].map(|name| root().join(name)))
        .collect()
}

#[test]
fn every_link_leads_to_a_file_and_the_readme_to_every_page() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    for page in pages() {
        let name = page.strip_prefix(root()).unwrap().to_str().unwrap();
        assert!(
            name == "README.md" || readme.contains(&format!("]({name})")),
            "README.md does not lead to {name}"
        );
        let text = std::fs::read_to_string(&page).unwrap();
        for link in text.split("](").skip(1).map(|rest| rest.split(')').next().unwrap()) {
            let file = link.split('#').next().unwrap();
            let is_file = !link.contains("://") && !file.is_empty();
            assert!(
                !is_file || page.parent().unwrap().join(file).exists(),
                "{}: {link}",
                page.display()
            );
        }
    }
}

#[test]
fn every_guarantee_names_tests_that_exist() {
    let test = regex_lite::Regex::new(r"#\[(?:\w+::)?test\]\s+(?:#\[.*\]\s+)*(?:async )?fn (\w+)\(").unwrap();
    let is_rust = |path: &PathBuf| path.extension().is_some_and(|end| end == "rs");
    let files = ["tests", "src"]
        .into_iter()
        .flat_map(|folder| walk(&root().join(folder)))
        .filter(is_rust);
    let texts: Vec<String> = files.map(|file| std::fs::read_to_string(file).unwrap()).collect();
    let tests: HashSet<&str> = texts
        .iter()
        .flat_map(|text| test.captures_iter(text).map(|found| found.get(1).unwrap().as_str()))
        .collect();
    // This test program has no harness, so its tests have no `#[test]`.
    let without_harness = std::fs::read_to_string(root().join("tests/simulation_limits/main.rs")).unwrap();
    let page = std::fs::read_to_string(root().join("docs/guarantees.md")).unwrap();
    let mut promises = 0;
    for row in page
        .lines()
        .filter(|line| line.starts_with("| ") && !line.ends_with("| shown by |"))
    {
        let shown_by = row.trim_end_matches(" |").rsplit(" | ").next().unwrap();
        let names: Vec<&str> = shown_by.split('`').skip(1).step_by(2).collect();
        assert!(!names.is_empty(), "nothing shows: {row}");
        for name in names
            .iter()
            .filter(|name| !name.starts_with("cargo bench ") && !root().join(name).is_file())
        {
            assert!(
                tests.contains(name) || without_harness.contains(name),
                "there is no test {name}"
            );
        }
        promises += 1;
    }
    assert!(promises > 15, "{promises}");
}

#[test]
fn every_file_that_contributors_are_sent_to_is_there() {
    let page = std::fs::read_to_string(root().join("CONTRIBUTING.md")).unwrap();
    let table = page
        .lines()
        .filter(|line| line.starts_with("| ") && line.contains("`s"));
    let files: Vec<&str> = table
        .flat_map(|row| row.split('`').skip(1).step_by(2))
        .filter(|name| name.contains('/'))
        .collect();
    assert!(files.len() > 8, "{files:?}");
    for file in files {
        assert!(
            root().join("src").join(file).exists() || root().join(file).exists(),
            "{file} is not there"
        );
    }
}

#[test]
fn every_test_module_that_contributors_are_sent_to_is_there() {
    let page = std::fs::read_to_string(root().join("CONTRIBUTING.md")).unwrap();
    let table = page.split("\n## Which tests cover a change\n").nth(1).unwrap();
    let table = table.split("\n## ").next().unwrap();
    let rows = table
        .lines()
        .filter(|row| row.starts_with("| ") && !row.starts_with("| change "));
    let cells = rows.filter_map(|row| row.split('|').nth(3));
    let names = cells.flat_map(|cell| cell.split('`').skip(1).step_by(2));
    let modules: Vec<&str> = names.flat_map(str::split_whitespace).collect();
    assert!(modules.len() > 30, "{modules:?}");
    for module in modules {
        let path = root()
            .join("tests")
            .join(module.trim_end_matches("::").replace("::", "/"));
        let is_there = path.is_dir() || path.with_extension("rs").is_file();
        assert!(is_there, "there are no tests {module}");
    }
}
