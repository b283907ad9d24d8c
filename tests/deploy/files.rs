//! The files of `deploy/`, checked by programs that read such files.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

fn deploy(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(path)
}

#[test]
fn the_units_expose_little() {
    needs!("systemd-analyze");
    // The simulation server runs untrusted programs with a GPU and a display, and can't be restricted further.
    // A user's service manager can restrict only system calls.
    for (unit, most) in [
        ("system/webots-session@.service", 1.5),
        ("system/webots-simulation@.service", 4.0),
        ("system/webots-fleet-packet-filter.service", 2.5),
        ("user/webots-session@.service", 6.5),
        ("user/webots-simulation@.service", 8.0),
    ] {
        let mut command = Command::new("systemd-analyze");
        let output = command
            .args(["security", "--offline=true", "--no-pager"])
            .arg(deploy("systemd").join(unit))
            .output();
        let said = String::from_utf8(output.unwrap().stdout).unwrap();
        let level = said
            .split("Overall exposure level")
            .nth(1)
            .and_then(|rest| rest.split(": ").nth(1));
        let level = level
            .and_then(|rest| rest.split(' ').next())
            .unwrap_or_else(|| panic!("{unit}: {said}"));
        assert!(level.parse::<f64>().unwrap() <= most, "{unit}: {said}");
    }
}

#[test]
fn the_autostart_entries_run_the_programs_of_the_units() {
    needs!("desktop-file-validate");
    for kind in ["session", "simulation"] {
        let file = deploy(&format!("autostart/webots-{kind}.desktop"));
        let text = std::fs::read_to_string(&file).unwrap();
        let command = text.lines().find_map(|line| line.strip_prefix("Exec=")).unwrap();
        let command = command
            .strip_prefix("sh -c \"")
            .and_then(|rest| rest.strip_suffix('"'))
            .unwrap();
        assert!(
            !command.contains(['\\', '$', '`', '"', '%']),
            "{command} would need quotes"
        );
        // Runs its command with stand-ins for the servers.
        let home = tempfile::tempdir().unwrap();
        std::os::unix::fs::symlink("/bin/echo", home.path().join(format!("{kind}-server"))).unwrap();
        let search = format!("{}:/usr/bin:/bin", home.path().display());
        let output = Command::new("sh")
            .args(["-c", command])
            .env("HOME", home.path())
            .env("PATH", search)
            .output();
        let said = String::from_utf8(output.unwrap().stdout).unwrap();
        assert_eq!(
            said.trim(),
            format!("{}/.config/webots-fleet/{kind}/main.json", home.path().display())
        );
        let validated = Command::new("desktop-file-validate").arg(&file).output().unwrap();
        assert!(validated.status.success(), "{validated:?}");
    }
}

/// The paths of the session server's routes, as the rules of web servers name them.
fn session_paths() -> BTreeSet<String> {
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/src");
    let folders =
        ["session/web", "shared/http"].map(|folder| std::fs::read_dir(Path::new(source).join(folder)).unwrap());
    let files = folders
        .into_iter()
        .flatten()
        .map(|file| std::fs::read_to_string(file.unwrap().path()).unwrap());
    let mut paths = BTreeSet::new();
    for text in files {
        let routes = text.split("path(\"/").skip(1).filter_map(|rest| rest.split_once('"'));
        paths.extend(routes.map(|(path, _)| {
            path.replace('.', "\\.")
                .replace("simulations/{id}", "simulations/[0-9T-]+")
                .replace("{name}", "[^/]+")
        }));
    }
    paths
}

#[test]
fn web_servers_lead_to_all_paths_of_the_session_server_and_to_no_others() {
    let all = session_paths();
    assert!(all.len() > 20, "{all:?}");
    for file in [
        "apache.conf",
        "nginx.conf",
        "nginx-door.conf",
        "swarm/door.conf",
        "kubernetes/base/config/fleet.conf",
    ] {
        let text = std::fs::read_to_string(deploy(file)).unwrap();
        let (_, rest) = text.split_once("session|request|").unwrap();
        let (names, _) = rest.split_once(")$").unwrap();
        let names = format!("session|request|{names}");
        let mut named: BTreeSet<_> = names.split('|').map(str::to_owned).collect();
        // Swarm and Kubernetes show the metrics only inside.
        named.insert("metrics".to_owned());
        assert_eq!(named, all, "{file}");
    }
}
