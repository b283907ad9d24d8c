//! The launcher of `config/simulation/docker`, which runs a participant's controller.

use std::path::Path;
use std::process::Command;

/// A stand-in for libController that records its calls. The simulation ends at the third step.
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

#[test]
fn a_participants_program_may_end_before_its_simulation() {
    needs!("cc");
    needs!("python3");
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    std::fs::create_dir_all(path("home/lib/controller")).unwrap();
    std::fs::create_dir_all(path("controllers/participant")).unwrap();
    std::fs::write(path("library.c"), LIBRARY).unwrap();
    let library = path("home/lib/controller/libController.so");
    let made = Command::new("cc")
        .args(["-shared", "-fPIC", "-o"])
        .args([&library, &path("library.c")])
        .status();
    assert!(made.unwrap().success());
    let launcher = path("controllers/remote_controller_launcher.py");
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/simulation/docker/remote_controller_launcher.py");
    std::fs::copy(source, &launcher).unwrap();
    std::fs::write(path("controllers/participant/beside.py"), "SAID = 'beside'").unwrap();
    let note = "import os, beside\nopen(os.environ['CALLS'], 'a').write(beside.SAID + '\\n')\n";
    let crash = "def deep():\n    raise ValueError('too deep')\ndeep()\n";
    for (program, told, untold) in [
        (Some(""), "", "Traceback"),
        (Some(crash), "line 4, in deep", "remote_controller_launcher"),
        (
            Some("raise SystemExit('enough')"),
            "The controller has ended: enough",
            "Traceback",
        ),
        (Some("raise KeyError('x' * 100_000)"), "xxxx'", "Traceback"),
        (Some("if True print()"), "SyntaxError", "remote_controller_launcher"),
        (None, "There is no participant/participant.py", "Traceback"),
    ] {
        let file = path("controllers/participant/participant.py");
        let calls = path("calls");
        std::fs::remove_file(&calls).ok();
        match program {
            Some(program) => std::fs::write(&file, format!("{note}{program}")).unwrap(),
            None => std::fs::remove_file(&file).unwrap(),
        }
        let mut python = Command::new("python3");
        let output = python
            .arg("-u")
            .arg(&launcher)
            .env("WEBOTS_HOME", path("home"))
            .env("CALLS", &calls)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        let ran = if program.is_some_and(|program| !program.starts_with("if True")) {
            "beside\n"
        } else {
            ""
        };
        let stays = "step 11\nstep 11\nstep 11\n";
        assert_eq!(
            std::fs::read_to_string(calls).unwrap(),
            format!("init 11\n{ran}{stays}"),
            "{program:?}: {said}"
        );
        assert!(said.contains(told) && !said.contains(untold), "{program:?}: {said}");
        assert!(output.status.success() && said.len() < 10_000, "{program:?}: {said}");
    }
}
