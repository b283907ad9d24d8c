//! `deploy/build-release`: the same commit and programs give the same files.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, SystemTime};

const PROGRAMS: [&str; 4] = ["session-server", "simulation-server", "demo-simulator", "rehearse"];

#[test]
fn a_release_that_is_made_again_has_the_same_checksums() {
    needs!("dpkg-deb");
    needs!("dpkg-shlibdeps");
    let folder = tempfile::tempdir().unwrap();
    let programs = folder.path().join("programs");
    std::fs::create_dir(&programs).unwrap();
    for program in PROGRAMS {
        // Any program of this machine serves.
        std::fs::copy("/bin/true", programs.join(program)).unwrap();
    }
    // A copy of the files, so that their times can be changed.
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let copy = folder.path().join("project");
    let clone = Command::new("git")
        .args(["clone", "--quiet", "--shared"])
        .arg(project)
        .arg(&copy)
        .status();
    assert!(clone.unwrap().success());
    std::fs::copy(project.join("deploy/build-release"), copy.join("deploy/build-release")).unwrap();
    let made = |name: &str, umask: &str, time: SystemTime| {
        for file in ["Cargo.toml", "README.md", "docs/scaling.md"] {
            let file = std::fs::File::options().append(true).open(copy.join(file)).unwrap();
            file.set_modified(time).unwrap();
        }
        let release = folder.path().join(name);
        let script = format!("umask {umask}; exec deploy/build-release \"$0\" -Zgzip -z1");
        let output = Command::new("bash")
            .args(["-c", &script])
            .arg(&release)
            .current_dir(&copy)
            .env("FLEET_BIN", &programs)
            .env_remove("SOURCE_DATE_EPOCH")
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        std::fs::read_to_string(release.join("SHA256SUMS")).unwrap()
    };
    let now = SystemTime::now();
    let first = made("first", "022", now);
    let second = made("second", "077", now - Duration::from_hours(1));
    assert_eq!(first, second);
    assert_eq!(first.lines().count(), 3, "{first}");
}
