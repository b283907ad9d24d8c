//! The images of a Webots and of an editor, under the real names: a Debian with real `xvfb-run`, `xauth`, `Xvfb` and
//! Python, and on top of it the layout of the official Dockerfiles.
//!
//! | stands in | for | because |
//! |---|---|---|
//! | the demo simulator | `webots-bin` | Webots is too large a download for these tests |
//! | `image/webots/webots` | its launcher | the demo simulator makes no folders for external controllers, so the script makes them |
//! | `image/webots/webots-controller` | `webots-controller` | the same; it reports the environment of a participant's program |
//! | the demo simulator | Theia | only its port, its user and its mounts matter here |

use std::path::Path;
use std::process::Command;

/// Name of the image for the worlds of the tests.
pub const NAME: &str = "cyberbotics/webots.cloud:R2025a-ubuntu22.04";
/// The image of an editor.
pub const EDITOR: &str = "benjamindeleze/theia-test:test3";
/// The Debian image below both.
const DEBIAN: &str = "webots-fleet.test/debian";
/// Exit code of a script that can't do its work on this machine.
const SKIPPED: i32 = 77;

/// Creates the archive of the Debian image, unless an earlier run has.
///
/// # Errors
/// If it can't be created.
pub fn prepare() -> Result<(), String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/image_root.sh");
    let status = Command::new(script).arg(archive()).status().unwrap();
    match status.code() {
        Some(0) => Ok(()),
        Some(SKIPPED) => Err("there is no mmdebstrap, or no mirror of Debian".to_owned()),
        _ => panic!("the Debian of the images can't be made: {status}"),
    }
}

fn archive() -> String {
    format!("{}/images.tar", env!("CARGO_TARGET_TMPDIR"))
}

/// Creates the images in the daemon; `folder` is for their build contexts.
pub fn make(folder: &Path) {
    super::daemon::import(folder, &archive(), DEBIAN);
    let simulator = Path::new(env!("CARGO_BIN_EXE_demo-simulator"));
    let world = crate::support::git::WORLD;
    for (name, parts, program) in [(NAME, "webots", "webots-bin"), (EDITOR, "editor", "demo-simulator")] {
        let context = folder.join(parts);
        let source = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/containers/image")
            .join(parts);
        let copied = Command::new("cp")
            .arg("-R")
            .arg(&source)
            .arg(&context)
            .status()
            .unwrap();
        assert!(copied.success());
        std::fs::copy(simulator, context.join(program)).unwrap();
        std::fs::write(context.join("editor.wbt"), world).unwrap();
        super::daemon::build(folder, &context, name);
    }
}
