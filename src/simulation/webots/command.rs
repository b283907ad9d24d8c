//! The command line of Webots.

use std::ffi::OsString;
use std::path::Path;
use std::time::Duration;

use crate::simulation::protocol::Mode;

/// The parameters of Webots' command line.
#[derive(Debug, Clone)]
pub struct WebotsCommand<'path> {
    /// Webots' launcher, or its replacement.
    pub program: &'path Path,
    /// How the simulation is shown.
    pub mode: Mode,
    /// The port to stream on.
    pub port: u16,
    /// The interval of its heartbeat.
    pub heartbeat: Duration,
    /// The world file.
    pub world: &'path Path,
}

impl WebotsCommand<'_> {
    /// The program and its arguments.
    ///
    /// The 3D stream is requested as plain `--stream`: R2025a rejects `--stream=x3d`, R2023b rejects `--stream=w3d`.
    /// The MJPEG stream shows the window, which therefore must be neither minimized nor without rendering.
    pub fn to_arguments(&self) -> Vec<OsString> {
        let mut arguments: Vec<OsString> = vec![self.program.into()];
        arguments.extend(["--batch", "--mode=pause"].map(OsString::from));
        if self.mode != Mode::Mjpeg {
            arguments.extend(["--minimize", "--no-rendering"].map(OsString::from));
        }
        arguments.push(format!("--port={}", self.port).into());
        arguments.push(format!("--heartbeat={}", self.heartbeat.as_millis()).into());
        arguments.push(if self.mode == Mode::Mjpeg { "--stream=mjpeg" } else { "--stream" }.into());
        arguments.push(self.world.into());
        arguments
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_the_documented_one() {
        let x3d = WebotsCommand {
            program: Path::new("/usr/local/webots/webots"),
            mode: Mode::X3d,
            port: 2001,
            heartbeat: Duration::from_secs(5),
            world: Path::new("/tmp/a b/worlds/$(id).wbt"),
        };
        let text =
            |command: &WebotsCommand| command.to_arguments().join(std::ffi::OsStr::new("|")).into_string().unwrap();
        let common = "/usr/local/webots/webots|--batch|--mode=pause|";
        let rest = "--port=2001|--heartbeat=5000|";
        let world = "|/tmp/a b/worlds/$(id).wbt";
        assert_eq!(text(&x3d), format!("{common}--minimize|--no-rendering|{rest}--stream{world}"));
        let w3d = WebotsCommand { mode: Mode::W3d, ..x3d.clone() };
        assert_eq!(text(&w3d), text(&x3d));
        let mjpeg = WebotsCommand { mode: Mode::Mjpeg, ..x3d };
        assert_eq!(text(&mjpeg), format!("{common}{rest}--stream=mjpeg{world}"));
    }
}
