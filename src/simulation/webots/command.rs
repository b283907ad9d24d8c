//! The command line of Webots.

use std::ffi::OsString;
use std::path::Path;
use std::time::Duration;

use crate::simulation::protocol::Mode;

/// The program, which is Webots' launcher or its replacement, and its arguments.
///
/// The 3D stream is requested as plain `--stream`: R2025a rejects `--stream=x3d`, R2023b rejects `--stream=w3d`.
/// The MJPEG stream shows the window, which therefore must be neither minimized nor without rendering.
pub fn webots_command(program: &Path, mode: Mode, port: u16, heartbeat: Duration, world: &Path) -> Vec<OsString> {
    let mut command: Vec<OsString> = vec![program.into()];
    command.extend(["--batch", "--mode=pause"].map(OsString::from));
    if mode != Mode::Mjpeg {
        command.extend(["--minimize", "--no-rendering"].map(OsString::from));
    }
    command.push(format!("--port={port}").into());
    command.push(format!("--heartbeat={}", heartbeat.as_millis()).into());
    command.push(if mode == Mode::Mjpeg { "--stream=mjpeg" } else { "--stream" }.into());
    command.push(world.into());
    command
}
