//! The files of `deploy/`: what programs that read such files say of them.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::needs;

fn deploy(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(path)
}

/// Runs a program of a package: whether it succeeds, and what it says.
fn run(package: &str, program: &str, arguments: &[&str]) -> (bool, String) {
    needs(program, package);
    // systemd's user mode wants the variable.
    let runtime = tempfile::tempdir().unwrap();
    let output = Command::new(program).args(arguments).env("XDG_RUNTIME_DIR", runtime.path()).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}

#[test]
fn the_units_expose_little_and_start_again_what_hangs_or_fails() {
    // The simulation server runs programs of others on the graphics card and a display, and can't close itself off more.
    // A user's own manager can't take away more than system calls.
    for (unit, most) in [
        ("system/webots-session@.service", 1.5),
        ("system/webots-simulation@.service", 4.0),
        ("system/webots-fleet-packet-filter.service", 2.5),
        ("user/webots-session@.service", 6.5),
        ("user/webots-simulation@.service", 8.0),
    ] {
        let file = deploy("systemd").join(unit);
        let arguments = ["security", "--offline=true", "--no-pager", file.to_str().unwrap()];
        let (_, said) = run("systemd", "systemd-analyze", &arguments);
        let line =
            said.lines().find(|line| line.contains("Overall exposure level")).unwrap_or_else(|| panic!("{said}"));
        let level: f64 = line.rsplit(": ").next().unwrap().split_whitespace().next().unwrap().parse().unwrap();
        assert!(level <= most, "{unit}: {level}\n{said}");
        let text = std::fs::read_to_string(&file).unwrap();
        for line in ["Type=notify", "WatchdogSec=30", "Restart=on-failure", "RestartPreventExitStatus=2"] {
            assert!(!unit.contains('@') || text.lines().any(|one| one == line), "{unit} has no {line}");
        }
    }
}

#[test]
fn the_autostart_entries_run_the_programs_of_the_units() {
    for kind in ["session", "simulation"] {
        let file = deploy(&format!("autostart/webots-{kind}.desktop"));
        let text = std::fs::read_to_string(&file).unwrap();
        let command = text.lines().find_map(|line| line.strip_prefix("Exec=")).unwrap();
        let command = command.strip_prefix("sh -c \"").and_then(|rest| rest.strip_suffix('"')).unwrap();
        assert!(!command.contains(['\\', '$', '`', '"', '%']), "{command} would need quotes");
        // What it runs, seen by stand-ins for the servers.
        let home = tempfile::tempdir().unwrap();
        let program = home.path().join(format!("{kind}-server"));
        std::os::unix::fs::symlink("/bin/echo", &program).unwrap();
        let search = format!("{}:/usr/bin:/bin", home.path().display());
        let output = Command::new("sh").args(["-c", command]).env("HOME", home.path()).env("PATH", search).output();
        let said = String::from_utf8(output.unwrap().stdout).unwrap();
        assert_eq!(said.trim(), format!("{}/.config/webots-fleet/{kind}/main.json", home.path().display()));
        let (fine, said) = run("desktop-file-utils", "desktop-file-validate", &[file.to_str().unwrap()]);
        assert!(fine, "{said}");
    }
}
