//! The image of a Webots, made from programs of this machine under the name of the real one.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

/// The name of the image for the worlds of the tests.
pub const NAME: &str = "cyberbotics/webots.cloud:R2025a-ubuntu22.04";
/// The image of an editor.
pub const EDITOR: &str = "benjamindeleze/theia-test:test3";

/// Programs that scripts in the image use.
const PROGRAMS: [&str; 24] = [
    "sh", "bash", "cat", "ls", "cp", "mkdir", "rm", "touch", "sleep", "head", "env", "true", "id", "dd", "make", "ln",
    "mv", "chmod", "mkfifo", "seq", "stat", "readlink", "perl", "tail",
];
/// Webots' launcher hands SIGTERM on.
const WEBOTS: &str = "#!/bin/sh\nunset DEMO_SIMULATOR_BIND\ndemo-simulator \"$@\" &\nchild=$!\ntrap 'kill -TERM $child' TERM INT\nwait $child\n\
                      code=$?\ntrap - TERM INT\nwait $child 2>/dev/null\nexit $code\n";
/// Leaves its options out, and runs the rest.
const XVFB: &str = "#!/bin/sh\nwhile [ \"${1#--}\" != \"$1\" ]; do shift; done\nexec \"$@\"\n";
/// An editor listens on port 3000.
const THEIA: &str = "#!/bin/sh\nexec demo-simulator --port=3000 --stream /world/worlds/a.wbt\n";

/// Makes the images in the daemon, with `folder` for what they are made of.
pub fn make(folder: &Path) {
    let root = folder.join("root");
    for (path, text) in [
        ("usr/bin/webots", WEBOTS),
        ("usr/bin/xvfb-run", XVFB),
        ("usr/bin/theia", THEIA),
        ("world/worlds/a.wbt", crate::support::git::WORLD),
    ] {
        let path = root.join(path);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
    }
    for folder in ["tmp", "run", "var/tmp", "usr/local", "etc", "proc", "sys", "dev"] {
        std::fs::create_dir_all(root.join(folder)).unwrap();
    }
    let found = |name: &str| {
        let paths = std::env::var_os("PATH").unwrap();
        let path = std::env::split_paths(&paths).map(|folder| folder.join(name)).find(|path| path.is_file());
        path.unwrap_or_else(|| panic!("there is no {name}")).canonicalize().unwrap().display().to_string()
    };
    let mut programs: Vec<(String, String)> =
        PROGRAMS.iter().map(|name| (found(name), format!("usr/bin/{name}"))).collect();
    programs.push((env!("CARGO_BIN_EXE_demo-simulator").to_owned(), "usr/bin/demo-simulator".to_owned()));
    for (from, to) in &programs {
        std::fs::copy(from, root.join(to)).unwrap_or_else(|error| panic!("{from}: {error}"));
        for library in libraries(from) {
            let to = root.join(library.trim_start_matches('/'));
            std::fs::create_dir_all(to.parent().unwrap()).unwrap();
            std::fs::copy(&library, to).unwrap();
        }
    }
    for (name, target) in [("bin", "usr/bin"), ("sbin", "usr/bin")] {
        std::os::unix::fs::symlink(target, root.join(name)).unwrap();
    }
    let tar = folder.join("root.tar");
    let made = Command::new("tar").arg("-C").arg(&root).arg("-cf").arg(&tar).arg(".").status().unwrap();
    assert!(made.success());
    let tar = tar.to_str().unwrap();
    super::daemon::import(folder, tar, NAME, &[]);
    super::daemon::import(folder, tar, EDITOR, &["--change", "CMD [\"/usr/bin/theia\"]"]);
}

/// The libraries of a program.
fn libraries(program: &str) -> Vec<String> {
    let output = Command::new("ldd").arg(program).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    text.split_whitespace()
        .filter(|word| word.starts_with('/'))
        .map(|word| word.trim_end_matches(':').to_owned())
        .collect()
}
