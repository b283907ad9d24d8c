//! The pages for readers.

use std::path::PathBuf;

use super::copy::{root, walk};

fn pages() -> Vec<PathBuf> {
    let docs = walk(&root().join("docs")).into_iter().filter(|path| path.extension().is_some_and(|end| end == "md"));
    docs.chain(["README.md", "CHANGELOG.md"].map(|name| root().join(name))).collect()
}

#[test]
fn every_link_to_a_file_leads_to_one() {
    for page in pages() {
        let text = std::fs::read_to_string(&page).unwrap();
        for link in text.split("](").skip(1).map(|rest| rest.split(')').next().unwrap()) {
            let file = link.split('#').next().unwrap();
            if !link.contains("://") && !file.is_empty() {
                assert!(page.parent().unwrap().join(file).exists(), "{}: {link}", page.display());
            }
        }
    }
}

#[test]
fn every_page_is_reached_from_the_readme() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    for page in pages() {
        let name = page.strip_prefix(root()).unwrap().to_str().unwrap();
        assert!(name == "README.md" || readme.contains(&format!("]({name})")), "README.md does not lead to {name}");
    }
}

#[test]
fn the_changelog_has_the_version_of_the_program() {
    let text = std::fs::read_to_string(root().join("CHANGELOG.md")).unwrap();
    let version = env!("CARGO_PKG_VERSION");
    assert!(text.contains("## [Unreleased]") || text.contains(&format!("## [{version}]")), "{version}");
}
