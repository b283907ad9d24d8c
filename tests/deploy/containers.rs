//! The files of `config/simulation/docker`: what compose makes of the templates, and what a participant's controller meets.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::{Value, json};

use crate::support::needs;

const KINDS: [&str; 3] = ["default", "theia", "competition"];
/// What the server tells compose.
const VARIABLES: &str = "IMAGE=webots-fleet/project:1\nCONTROLLER_IMAGE=webots-fleet/controller:1\nTHEIA_IMAGE=editor:1\n\
    PROJECT_PATH=/usr/local/webots-project\nMAKE=0\nPORT=2001\nTHEIA_PORT=2501\nCOMPOSE_PROJECT_NAME=one\n\
    THEIA_VOLUME=webots-project/controllers/edit/\nTHEIA_FOLDER=/srv/one/project/controllers/edit\n\
    PROJECT=/srv/one/project\nIPC=/srv/one/ipc\nBIND=127.0.0.1\n";

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/simulation/docker").join(name)
}

/// The kinds of compose that are here. Nothing, and a word, where there is none.
fn composes() -> Vec<&'static [&'static str]> {
    let all: [&[&str]; 2] = [&["docker-compose"], &["docker", "compose"]];
    let works = |command: &&[&str]| {
        let output = Command::new(command[0]).args(&command[1..]).arg("version").output();
        output.is_ok_and(|output| output.status.success())
    };
    let found: Vec<&[&str]> = all.into_iter().filter(works).collect();
    if found.is_empty() {
        // Not by a macro: what those print is shown for tests that fail only.
        std::io::stderr().write_all(b"SKIPPED, for there is no docker compose: deploy::containers\n").unwrap();
    }
    found
}

/// The services of a template as compose understands it, without what depends on its version.
fn services(compose: &[&str], template: &str) -> BTreeMap<String, Value> {
    let folder = tempfile::tempdir().unwrap();
    let variables = folder.path().join(".env");
    std::fs::write(&variables, VARIABLES).unwrap();
    let output = Command::new(compose[0])
        .args(&compose[1..])
        .args(["--env-file", variables.to_str().unwrap(), "--project-directory", folder.path().to_str().unwrap()])
        .args(["-f", file(template).to_str().unwrap(), "config"])
        // Those of the machine would come before those of the file.
        .env_clear()
        .envs(std::env::vars().filter(|(name, _)| name == "PATH" || name == "HOME"))
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{template}: {}", String::from_utf8_lossy(&output.stderr));
    let document: Value = serde_saphyr::from_str(&text).unwrap();
    let services = document["services"].as_object().unwrap().clone();
    services.into_iter().map(|(name, service)| (name, plain(service))).collect()
}

/// A service with its ports and volumes as they are in the template.
fn plain(mut service: Value) -> Value {
    let number = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let service_map = service.as_object_mut().unwrap();
    service_map.remove("networks");
    for (key, entries) in service_map.iter_mut().filter(|(key, _)| *key == "ports" || *key == "volumes") {
        for entry in entries.as_array_mut().unwrap() {
            let short = match (key.as_str(), &*entry) {
                ("ports", Value::Object(port)) => {
                    format!("{}:{}:{}", number(&port["host_ip"]), number(&port["published"]), number(&port["target"]))
                }
                ("volumes", Value::Object(mount)) => {
                    format!("{}:{}", number(&mount["source"]), number(&mount["target"]))
                }
                (_, text) => text.as_str().unwrap().trim_end_matches(":rw").trim_end_matches("/tcp").to_owned(),
            };
            *entry = json!(short.replace("/edit/", "/edit"));
        }
    }
    for empty in ["command", "entrypoint"] {
        if service[empty].is_null() {
            service.as_object_mut().unwrap().remove(empty);
        }
    }
    service
}

/// What each kind comes to.
fn expected(kind: &str) -> BTreeMap<String, Value> {
    let ipc = ["/srv/one/ipc:/tmp/webots-2001", "/srv/one/ipc:/tmp/webots"];
    let is_competition = kind == "competition";
    let shared: &[&str] = if is_competition { &ipc } else { &[] };
    let mounts = [&["/srv/one/project:/usr/local/webots-project"], shared].concat();
    let webots = json!({
        "image": "webots-fleet/project:1",
        "working_dir": "/usr/local/webots-project",
        "environment": {"USER": "webots"},
        "ports": ["127.0.0.1:2001:2001"],
        "volumes": mounts,
    });
    let theia = json!({
        "image": "editor:1",
        "ports": ["127.0.0.1:2501:3000"],
        "volumes": ["/srv/one/project/controllers/edit:/home/project/webots-project"],
    });
    let folder = "/srv/one/project/controllers/edit:/usr/local/webots-project/controllers/edit";
    let controller = json!({
        "image": "webots-fleet/controller:1",
        "tty": true,
        "environment": {
            "USER": "webots", "WEBOTS_CONTROLLER_URL": "participant", "PORT": "2001", "WEBOTS_STDOUT_REDIRECT": "1",
            "WEBOTS_STDERR_REDIRECT": "1",
        },
        "volumes": [folder, ipc[0], ipc[1]],
    });
    let all =
        [("webots", webots, true), ("theia", theia, kind != "default"), ("controller", controller, is_competition)];
    all.into_iter().filter(|(_, _, is_there)| *is_there).map(|(name, service, _)| (name.to_owned(), service)).collect()
}

#[test]
fn a_template_asks_for_its_services_and_no_more() {
    for compose in composes() {
        for kind in KINDS {
            let services = services(compose, &format!("docker-compose-{kind}.yml"));
            assert_eq!(services, expected(kind), "{compose:?} {kind}");
        }
    }
}

#[test]
fn a_template_for_finding_faults_gives_a_terminal_and_no_right() {
    for compose in composes() {
        for kind in KINDS {
            let mut services = services(compose, &format!("docker-compose-{kind}-debug.yml"));
            for (name, service) in &mut services {
                let service = service.as_object_mut().unwrap();
                let terminal = [service.remove("tty"), service.remove("stdin_open")];
                assert_eq!(
                    terminal.iter().all(|one| *one == Some(json!(true))),
                    name != "theia",
                    "{name}: {service:?}"
                );
                if let Some(Value::Object(environment)) = service.get_mut("environment") {
                    assert_eq!(environment.remove("PYTHONFAULTHANDLER"), Some(json!("1")));
                    for name in ["PYTHONUNBUFFERED", "LIBGL_DEBUG", "QT_DEBUG_PLUGINS"] {
                        environment.remove(name);
                    }
                }
            }
            // The participant's controller has one in any case.
            let mut expected = expected(kind);
            expected.get_mut("controller").map(|service| service.as_object_mut().unwrap().remove("tty"));
            assert_eq!(services, expected, "{compose:?} {kind}");
        }
    }
}

/// A stand-in for libController, which writes down what it is asked for. The simulation ends at the third step.
const LIBRARY: &str = r#"
    #include <stdio.h>
    #include <stdlib.h>
    static void note(const char *what) {
        FILE *file = fopen(getenv("CALLS"), "a");
        fprintf(file, "%s %s%s\n", what, getenv("WEBOTS_STDOUT_REDIRECT"), getenv("WEBOTS_STDERR_REDIRECT"));
        fclose(file);
    }
    int wb_robot_init() { note("init"); return 1; }
    double wb_robot_get_basic_time_step() { return 16; }
    int wb_robot_step(int duration) {
        static int steps = 0;
        note(duration == 16 ? "step" : "wrong step");
        return ++steps == 3 ? -1 : 0;
    }
"#;

/// Runs the launcher for a participant's program, if there is one: what it printed, and what libController was asked for.
fn launch(program: Option<&str>) -> (String, Output) {
    needs("cc", "gcc");
    needs("python3", "python3");
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    std::fs::create_dir_all(path("home/lib/controller")).unwrap();
    std::fs::create_dir_all(path("controllers/participant")).unwrap();
    std::fs::write(path("library.c"), LIBRARY).unwrap();
    let library = path("home/lib/controller/libController.so");
    let made =
        Command::new("cc").args(["-shared", "-fPIC", "-o"]).args([&library, &path("library.c")]).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let launcher = path("controllers/remote_controller_launcher.py");
    std::fs::copy(file("remote_controller_launcher.py"), &launcher).unwrap();
    if let Some(program) = program {
        std::fs::write(path("controllers/participant/participant.py"), program).unwrap();
        std::fs::write(path("controllers/participant/beside.py"), "SAID = 'beside'").unwrap();
    }
    let output = Command::new("python3")
        .args(["-u", launcher.to_str().unwrap()])
        .env("WEBOTS_HOME", path("home"))
        .env("CALLS", path("calls"))
        .output()
        .unwrap();
    (std::fs::read_to_string(path("calls")).unwrap(), output)
}

#[test]
fn a_participant_s_program_runs_connected_and_is_not_missed_when_it_ends() {
    let stays = "step 11\nstep 11\nstep 11\n";
    let note = "import os, beside\nopen(os.environ['CALLS'], 'a').write(beside.SAID + '\\n')\n";
    let crash = "def deep():\n    raise ValueError('too deep')\ndeep()\n";
    for (program, told, untold) in [
        (Some(String::new()), "", "Traceback"),
        (Some(crash.to_owned()), "line 4, in deep", "remote_controller_launcher"),
        (Some("raise SystemExit('enough')".to_owned()), "The controller has ended: enough", "Traceback"),
        (Some("import sys; sys.exit(0)".to_owned()), "", "ended"),
        (Some("raise KeyError('x' * 100_000)".to_owned()), "xxxx'", "Traceback"),
        (Some("if True print()".to_owned()), "SyntaxError", "remote_controller_launcher"),
        (None, "There is no participant/participant.py", "Traceback"),
    ] {
        let is_read = program.as_ref().is_some_and(|program| !program.starts_with("if True"));
        let (calls, output) = launch(program.as_ref().map(|program| format!("{note}{program}")).as_deref());
        let said = String::from_utf8_lossy(&output.stderr);
        let ran = if is_read { "beside\n" } else { "" };
        assert_eq!(calls, format!("init 11\n{ran}{stays}"), "{program:?}: {said}");
        assert!(said.contains(told) && !said.contains(untold), "{program:?}: {said}");
        assert!(output.status.success() && said.len() < 10_000, "{program:?}: {said}");
    }
}
