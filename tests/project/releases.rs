//! The notes of a release, as `.github/workflows/release.yml` takes them from `CHANGELOG.md`.

use std::path::Path;
use std::process::{Command, Output};

use super::copy::root;

/// The script of the workflow's step of this name, which is the last key of its step.
fn script(step: &str) -> String {
    let workflow = std::fs::read_to_string(root().join(".github/workflows/release.yml")).unwrap();
    let (_, rest) = workflow.split_once(&format!("- name: {step}\n")).expect("the step");
    let (_, rest) = rest.split_once("run: |\n").expect("a script");
    let lines = rest.lines().take_while(|line| !line.trim_start().starts_with("- "));
    lines.collect::<Vec<_>>().join("\n")
}

fn take_notes(tag: &str, temporary: &Path) -> Output {
    Command::new("bash")
        // As the runner does.
        .args(["-e", "-c", &script("Take the notes of this version")])
        .current_dir(root())
        .env("GITHUB_REF_NAME", tag)
        .env("RUNNER_TEMP", temporary)
        .output()
        .unwrap()
}

#[test]
fn a_release_has_the_dated_notes_of_its_version() {
    let temporary = tempfile::tempdir().unwrap();
    let version = env!("CARGO_PKG_VERSION");
    let output = take_notes(&format!("v{version}"), temporary.path());
    assert!(output.status.success(), "{output:?}");
    let notes = std::fs::read_to_string(temporary.path().join("notes.md")).unwrap();
    let changelog = std::fs::read_to_string(root().join("CHANGELOG.md")).unwrap();
    let (_, rest) = changelog.split_once(&format!("\n## [{version}] - ")).expect("a date");
    let (date, rest) = rest.split_once('\n').unwrap();
    assert!(
        date.len() == 10 && date.split('-').all(|part| part.parse::<u16>().is_ok()),
        "{date}"
    );
    let expected = rest.split("\n## [").next().unwrap();
    assert_eq!(notes.trim(), expected.trim());
    assert!(notes.contains("\n### Added\n"), "{notes}");
}

#[test]
fn a_tag_of_another_version_is_no_release() {
    let temporary = tempfile::tempdir().unwrap();
    let output = take_notes("v999.0.0", temporary.path());
    assert!(!output.status.success(), "{output:?}");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("error: the tag is v999.0.0"), "{errors}");
}
