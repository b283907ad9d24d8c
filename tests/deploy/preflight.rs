//! `simulation-server --check`: the configuration on standard output, what the machine has and lacks on standard error.

use std::os::unix::fs::symlink;
use std::process::Command;

use serde_json::{Value, json};

use crate::support::webots::Webots;

/// Runs `--check` with these keys; returns the configuration and the messages on standard error.
pub fn check(keys: &Value, change: impl FnOnce(&mut Command)) -> (Value, String) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("config.json");
    let mut config = json!({"server": "localhost", "allowedRepositories": "https://github.com/lab"});
    config
        .as_object_mut()
        .unwrap()
        .extend(keys.as_object().unwrap().clone());
    std::fs::write(&file, config.to_string()).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_simulation-server"));
    command.arg("--check").arg(&file).env_remove("WEBOTS_HOME");
    change(&mut command);
    let output = command.output().unwrap();
    let told = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{told}");
    (serde_json::from_slice(&output.stdout).unwrap(), told)
}

#[test]
fn nothing_is_warned_about_where_all_is_there() {
    let webots = Webots::script("exit 0");
    let programs = tempfile::tempdir().unwrap();
    let git = Webots::script("echo \"git version 2.39.5 $*\"");
    for (name, program) in [("git", &git), ("git-lfs", &git), ("Xvfb", &webots)] {
        symlink(program.path(), programs.path().join(name)).unwrap();
    }
    let search = format!("{}:/usr/bin:/bin", programs.path().display());
    let (config, told) = check(&json!({"webots": webots.path(), "xvfb": true}), |command| {
        command.env("PATH", search);
    });
    assert_eq!(config["xvfb"], true);
    let expected = format!(
        "webots: {}\ndisplay: each Webots gets a virtual display of its own (xvfb), without the graphics card\n\
         git: git version 2.39.5 --version\ngit-lfs: git version 2.39.5 --version\n\
         isolation: sandbox\nnetwork: ",
        webots.path().display()
    );
    // The network is either the machine's, or each simulation has its own.
    assert!(told.starts_with(&expected) && told.lines().count() == 6, "{told}");
}

#[test]
fn what_is_missing_or_does_not_fit_is_warned_about() {
    let empty = crate::support::programs(&["prlimit"]);
    let users = |trusted: &str| json!({"isolation": "none", "userHeader": "X-User", "trustedProxies": [trusted]});
    let pose = "worlds' programs can pose as any user";
    for (keys, told_of, untold) in [
        (
            json!({"webotsHome": "/nowhere", "xvfb": true}),
            "webots: This simulation server has no Webots that it can run at \"/nowhere/webots\". Its administrator can set webotsHome\n\
             display: This simulation server gives each Webots a display of its own (xvfb), but has no Xvfb.\n\
             git: git is not there: no world can be checked out\n\
             git-lfs: git-lfs is not there: large files of Git LFS will be missing\n\
             isolation: none, worlds' programs may do whatever this user may: bubblewrap (bwrap) is not there; on Debian, \
             Ubuntu and Fedora the package bubblewrap has it",
            pose,
        ),
        (
            json!({"isolation": "sandbox", "display": ":59000"}),
            "isolation: the server does not start: isolation is \"sandbox\", but bubblewrap\n\
             webots: This simulation server does not know where Webots is installed. Its administrator can set webotsHome",
            pose,
        ),
        (
            json!({"sandbox": {"readable": "/nowhere/at/all"}}),
            "sandbox: /nowhere/at/all is not there",
            pose,
        ),
        (
            json!({"isolation": "none", "allowedRepositories": [], "maxConnections": 20}),
            "isolation: none\nwarning: streams: any file that this user may read, such as this server's configuration, can \
             be read by anybody who reaches ports 2001 to 2020\nallowedRepositories is not set: no world will run here",
            "relayed",
        ),
        (
            json!({"docker": true, "allowedRepositories": []}),
            "allowedRepositories is not set: any repository runs while the load is at most 50 % (shareIdleTime)",
            "no world will run here",
        ),
        (
            json!({"docker": true, "shareIdleTime": 0, "allowedRepositories": []}),
            "allowedRepositories is not set: no world will run here",
            "any repository",
        ),
        (users("127.0.0.1"), pose, "streams: relayed"),
        (users("::1"), pose, "streams: relayed"),
        (users("192.0.2.1"), "isolation: none", pose),
    ] {
        let (_, told) = check(&keys, |command| {
            command.env("PATH", empty.path());
        });
        assert!(
            told_of.lines().all(|words| told.contains(words)),
            "{told_of} is not in\n{told}"
        );
        assert!(!told.contains(untold), "{untold} is in\n{told}");
    }
}

#[test]
fn a_relay_in_a_shared_network_needs_a_packet_filter() {
    let relay = json!({"isolation": "none", "streaming": "relay", "port": 3000, "maxConnections": 20});
    let words = if nix::unistd::geteuid().is_root() {
        "warning: streams: anybody who reaches ports 3001 to 3020 can control simulations"
    } else {
        "\nstreams: relayed; the firewall has to close ports 3001 to 3020"
    };
    let (_, told) = check(&relay, |_| ());
    assert!(told.contains(words), "{words} is not in\n{told}");
}
