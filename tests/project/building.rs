//! What `server.sh` builds, with a stand-in for cargo that records its arguments and provides the programs under test.

use std::process::Command;

use super::copy::{Project, programs};
use crate::support::make_program;

const CARGO: &str = r#"echo "$@" >>calls
mkdir -p target/release
cp --remove-destination "$PROGRAMS"/session-server "$PROGRAMS"/simulation-server "$PROGRAMS"/demo-simulator target/release
"#;

/// Starts and stops the servers; returns the output of the start, and the recorded calls of cargo.
fn start(project: &Project, name: &str) -> (String, String) {
    let server_sh = |arguments: &[&str]| {
        let path = format!(
            "{}:{}",
            project.path("bin-of-cargo").display(),
            std::env::var("PATH").unwrap()
        );
        let mut command = Command::new(project.path("server.sh"));
        let output = command
            .args(arguments)
            .env("PATH", path)
            .env("PROGRAMS", programs())
            .env_remove("FLEET_BIN")
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(
            output.status.success(),
            "{said}{}",
            String::from_utf8_lossy(&output.stderr)
        );
        said
    };
    let said = server_sh(&["start", name]);
    server_sh(&["stop", name]);
    let calls = std::fs::read_to_string(project.path("calls")).unwrap_or_default();
    std::fs::write(project.path("calls"), "").unwrap();
    (said, calls)
}

#[test]
fn a_start_builds_changed_programs() {
    let project = Project::copy();
    for folder in ["src", "templates", "bin-of-cargo"] {
        std::fs::create_dir(project.path(folder)).unwrap();
    }
    for file in ["Cargo.toml", "Cargo.lock", "rust-toolchain.toml", "src/lib.rs"] {
        std::fs::write(project.path(file), "").unwrap();
    }
    make_program(&project.path("bin-of-cargo/cargo"), CARGO);
    let servers = "build --release --locked --bin simulation-server --bin session-server";

    let (said, asked) = start(&project, "demo");
    assert!(
        said.starts_with("builds the programs first, which takes about three minutes on two cores"),
        "{said}"
    );
    assert_eq!(asked, format!("{servers} --bin demo-simulator --target-dir target\n"));
    assert_eq!(start(&project, "demo").1, "", "nothing has changed");
    std::fs::write(project.path("src/lib.rs"), "// changed").unwrap();
    let (said, asked) = start(&project, "local");
    assert!(!said.contains("three minutes"), "{said}");
    assert_eq!(asked, format!("{servers} --target-dir target\n"));
    assert_eq!(
        start(&project, "demo").1,
        format!("{servers} --bin demo-simulator --target-dir target\n")
    );
}
