//! The launcher of `config/simulation/docker`: what a participant's controller meets.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::support::needs;
fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config/simulation/docker").join(name)
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
