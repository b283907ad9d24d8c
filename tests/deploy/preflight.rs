//! `simulation-server --check`: the configuration on standard output, what the machine has and lacks beside it.

use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

use crate::support::webots::Webots;

/// Runs `--check` with these keys; gives back what it prints and what it tells beside.
pub fn check(keys: &Value, change: impl FnOnce(&mut Command)) -> (Value, String) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("config.json");
    let mut config = json!({"server": "localhost", "allowedRepositories": "https://github.com/lab"});
    config.as_object_mut().unwrap().extend(keys.as_object().unwrap().clone());
    std::fs::write(&file, config.to_string()).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_simulation-server"));
    command.arg("--check").arg(&file).env_remove("WEBOTS_HOME");
    change(&mut command);
    let output = command.output().unwrap();
    let told = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{told}");
    (serde_json::from_slice(&output.stdout).unwrap(), told)
}

fn path(folder: &Path) -> impl FnOnce(&mut Command) {
    move |command| {
        command.env("PATH", folder);
    }
}

#[test]
fn nothing_is_warned_about_where_all_is_there() {
    let (webots, programs) = (Webots::script("exit 0"), tempfile::tempdir().unwrap());
    for program in ["git-lfs", "Xvfb"] {
        symlink(webots.path(), programs.path().join(program)).unwrap();
    }
    let echo = Webots::script("echo \"git version 2.39.5 $*\"");
    for program in ["git", "git-lfs"] {
        std::fs::remove_file(programs.path().join(program)).ok();
        symlink(echo.path(), programs.path().join(program)).unwrap();
    }
    let search = format!("{}:/usr/bin:/bin", programs.path().display());
    let (config, told) = check(&json!({"webots": webots.path(), "xvfb": true}), |command| {
        command.env("PATH", search);
    });
    assert_eq!(config["xvfb"], true);
    let expected = format!(
        "webots: {}\ndisplay: each Webots gets a virtual display of its own (xvfb), without the graphics card\n\
         git: git version 2.39.5 --version\ngit-lfs: git version 2.39.5 --version\nXvfb: {}/Xvfb\n\
         isolation: sandbox\nnetwork: ",
        webots.path().display(),
        programs.path().display()
    );
    // The network is the machine's or one of each simulation's own.
    assert!(told.starts_with(&expected) && told.lines().count() == 7, "{told}");
}

#[test]
fn what_is_missing_is_warned_about() {
    let empty = crate::support::programs(&["prlimit"]);
    for (keys, warnings) in [
        (
            json!({"webotsHome": "/nowhere", "xvfb": true}),
            "webots: there is no program /nowhere/webots; webotsHome is the folder that Webots is installed in\n\
             git: git is not there: no world can be checked out\n\
             git-lfs: git-lfs is not there: large files of Git LFS will be missing\n\
             Xvfb: it is not there, but xvfb is true: no Webots can start.\n\
             isolation: none, worlds' programs may do whatever this user may: bubblewrap (bwrap) is not there; on Debian, \
             Ubuntu and Fedora the package bubblewrap has it",
        ),
        (
            json!({"isolation": "sandbox", "display": ":59000"}),
            "isolation: the server does not start: isolation is \"sandbox\", but bubblewrap\n\
             webots: neither webotsHome nor the environment variable WEBOTS_HOME is set",
        ),
    ] {
        let (_, told) = check(&keys, path(empty.path()));
        for words in warnings.lines() {
            assert!(told.contains(&format!("warning: {words}")), "{words} is not in\n{told}");
        }
    }
    for (keys, words) in [
        (json!({"isolation": "none"}), "\nisolation: none\n"),
        (json!({"sandbox": {"readable": "/nowhere/at/all"}}), "sandbox: /nowhere/at/all is not there\n"),
    ] {
        let (_, told) = check(&keys, path(empty.path()));
        assert!(told.contains(words), "{told}");
    }
}

#[test]
fn displays_that_do_not_fit_the_gpus_are_warned_about() {
    let library = crate::simulation::readings::gpu_driver();
    let webots = Webots::script("exit 0");
    let table = [
        (json!([]), "4", "GPUs: simulations are spread over Stand-in A, Stand-in B, Stand-in C, Stand-in D\n"),
        (
            json!([":90.0", ":90.1"]),
            "4",
            "warning: GPUs: displays names 2 of 4 GPUs' X screens: the other GPUs get no simulation\n",
        ),
        (json!([":90.0", ":90.1"]), "1", "warning: GPUs: displays names 2 X screens, but there are 1 GPUs\n"),
        (
            json!([]),
            "0",
            "warning: GPUs: gpus is \"spread\", but no NVIDIA GPU is read, so none is chosen: NVIDIA's driver knows none\n",
        ),
    ];
    for (displays, count, words) in table {
        let keys = json!({"webots": webots.path(), "gpus": "spread", "displays": displays});
        let (_, told) = check(&keys, |command| {
            command.env("LD_LIBRARY_PATH", library.path()).env("NVML_COUNT", count);
        });
        assert!(told.contains(words), "{words} is not in\n{told}");
    }
    let (_, told) = check(&json!({"displays": [":90.0"]}), |_| ());
    assert!(told.contains("displays has no effect") && !told.contains("GPUs: "), "{told}");
}

#[test]
fn whose_worlds_run_is_warned_about_where_the_configuration_does_not_say() {
    for (keys, effect) in [
        (json!({"isolation": "none", "allowedRepositories": []}), "no world will run here"),
        (
            json!({"docker": true, "allowedRepositories": []}),
            "any repository runs while the load is at most 50 % (shareIdleTime)",
        ),
        (json!({"docker": true, "shareIdleTime": 0, "allowedRepositories": []}), "no world will run here"),
    ] {
        let told = check(&keys, |_| ()).1;
        assert!(told.contains(&format!("allowedRepositories is not set: {effect}")), "{keys}: {told}");
    }
}

#[test]
fn what_weakens_a_relay_in_a_shared_network_is_warned_about() {
    let told = |keys: &Value| check(keys, |_| ()).1;
    let words = "worlds' programs can pose as any user";
    let users = |trusted: &str| json!({"isolation": "none", "userHeader": "X-User", "trustedProxies": [trusted]});
    for (keys, is_warned) in [
        (users("127.0.0.1"), true),
        (users("::1"), true),
        (users("192.0.2.1"), false),
        (json!({"isolation": "none"}), false),
    ] {
        assert_eq!(told(&keys).contains(words), is_warned, "{keys}");
    }
    let relay = json!({"isolation": "none", "streaming": "relay", "port": 3000, "maxConnections": 20});
    let is_root = nix::unistd::geteuid().is_root();
    let words = if is_root {
        "warning: streams: anybody who reaches ports 3001 to 3020 can control simulations"
    } else {
        "\nstreams: relayed; the firewall has to close ports 3001 to 3020"
    };
    assert!(told(&relay).contains(words), "{words}");
    assert!(!told(&json!({"isolation": "none"})).contains("streams: "));
}
