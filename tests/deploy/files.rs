//! The files of `deploy/`: what programs that read such files say of them.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

use crate::support::needs;

fn deploy(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(path)
}

fn units() -> Vec<PathBuf> {
    let kinds = ["systemd/system", "systemd/user"];
    let files = kinds.iter().flat_map(|kind| std::fs::read_dir(deploy(kind)).unwrap());
    files.map(|file| file.unwrap().path()).collect()
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
fn systemd_finds_no_fault_in_the_units() {
    for unit in units() {
        let folder = tempfile::tempdir().unwrap();
        let text = std::fs::read_to_string(&unit).unwrap();
        // The programs are looked for where the package installs them. The folder of those here may have a space in its name.
        let programs = folder.path().join("programs");
        let built = Path::new(env!("CARGO_BIN_EXE_session-server")).parent().unwrap();
        std::os::unix::fs::symlink(built, &programs).unwrap();
        let text = text.replace("/usr/bin/", &format!("{}/", programs.display()));
        let name = unit.file_name().unwrap().to_str().unwrap().replace('@', "@main");
        let copy = folder.path().join(name);
        std::fs::write(&copy, text).unwrap();
        for other in units().iter().filter(|other| other.parent() == unit.parent() && **other != unit) {
            std::fs::copy(other, folder.path().join(other.file_name().unwrap())).unwrap();
        }
        let kind = if unit.to_str().unwrap().contains("/user/") { "--user" } else { "--system" };
        let arguments = ["verify", kind, "--man=no", copy.to_str().unwrap()];
        let (fine, said) = run("systemd", "systemd-analyze", &arguments);
        let own: Vec<&str> = said.lines().filter(|line| line.contains("webots-")).collect();
        let missing_programs = own.iter().all(|line| line.contains("Command /usr/bin/"));
        assert!(missing_programs && (fine || !own.is_empty()), "{}: {said}", unit.display());
    }
}

#[test]
fn the_units_expose_little() {
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
    }
}

#[test]
fn the_units_and_the_script_start_the_same_programs_with_a_configuration_each() {
    let is_server = |unit: &&PathBuf| unit.to_str().unwrap().ends_with("@.service");
    for unit in units().iter().filter(is_server) {
        let text = std::fs::read_to_string(unit).unwrap();
        let kind = if unit.to_str().unwrap().contains("webots-session@") { "session" } else { "simulation" };
        let command = text.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let folder = if unit.to_str().unwrap().contains("/user/") { "%E" } else { "/etc" };
        assert_eq!(
            command,
            format!("/usr/bin/{kind}-server {folder}/webots-fleet/{kind}/%i.json"),
            "{}",
            unit.display()
        );
        for line in ["Type=notify", "WatchdogSec=30", "Restart=on-failure", "RestartPreventExitStatus=2"] {
            assert!(text.lines().any(|one| one == line), "{line} is not in {}", unit.display());
        }
    }
    let script = std::fs::read_to_string(deploy("../server.sh")).unwrap();
    assert!(script.contains("\"$BIN/$kind-server\" --pid-file \"log/$1.pid\" \\\n        \"config/$1.json\""));
}

#[test]
fn the_example_configurations_are_valid_and_reach_nobody_outside() {
    for (kind, program) in
        [("session", env!("CARGO_BIN_EXE_session-server")), ("simulation", env!("CARGO_BIN_EXE_simulation-server"))]
    {
        let file = deploy("config").join(kind).join("main.json");
        let output = Command::new(program).arg("--check").arg(&file).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{told}");
        assert!(!told.contains("unknown key") && !told.contains("is not set"), "{told}");
        let config: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(config["bind"], "127.0.0.1");
        assert_eq!(config["logDir"], format!("/var/log/webots-{kind}"));
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
