//! The command line of Webots.

use std::ffi::OsString;
use std::path::Path;
use std::time::Duration;

use crate::simulation::protocol::Mode;

/// What Webots is started with.
#[derive(Debug, Clone)]
pub struct Launch<'path> {
    /// Webots' launcher, or what stands in for it.
    pub program: &'path Path,
    /// How the simulation is shown.
    pub mode: Mode,
    /// The port to stream on.
    pub port: u16,
    /// Between two signs of life.
    pub heartbeat: Duration,
    /// The world file.
    pub world: &'path Path,
    /// Whether to give it a virtual display of its own.
    pub xvfb: bool,
    /// The instance's folder, for the display's authority file: it is removed in whatever way the display ends.
    pub instance: &'path Path,
}

impl Launch<'_> {
    /// The argument list.
    ///
    /// The 3D stream is asked for as plain `--stream`: `--stream=x3d` is refused by R2025a, `--stream=w3d` by R2023b.
    /// The MJPEG stream shows the window, which therefore must be neither minimized nor without rendering.
    #[must_use]
    pub fn arguments(&self) -> Vec<OsString> {
        let mut arguments: Vec<OsString> = Vec::new();
        if self.xvfb {
            let screen = "-screen 0 1280x1024x24 -nolisten tcp";
            arguments.extend(["xvfb-run", "--auto-servernum", "--server-args", screen].map(OsString::from));
            let authority = self.instance.join("Xauthority");
            // xvfb-run hands the name on without quotes.
            let is_plain = |byte: &u8| byte.is_ascii_alphanumeric() || b"/._-".contains(byte);
            if authority.as_os_str().as_encoded_bytes().iter().all(is_plain) {
                arguments.extend([OsString::from("--auth-file"), authority.into()]);
            }
        }
        arguments.push(self.program.into());
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
        let launch = Launch {
            program: Path::new("/usr/local/webots/webots"),
            mode: Mode::X3d,
            port: 2001,
            heartbeat: Duration::from_secs(5),
            world: Path::new("/tmp/a b/worlds/$(id).wbt"),
            xvfb: false,
            instance: Path::new("/tmp/a b"),
        };
        let text = |launch: &Launch| launch.arguments().join(std::ffi::OsStr::new("|")).into_string().unwrap();
        let common = "/usr/local/webots/webots|--batch|--mode=pause|";
        let rest = "--port=2001|--heartbeat=5000|";
        let world = "|/tmp/a b/worlds/$(id).wbt";
        assert_eq!(text(&launch), format!("{common}--minimize|--no-rendering|{rest}--stream{world}"));
        let w3d = Launch { mode: Mode::W3d, ..launch.clone() };
        assert_eq!(text(&w3d), text(&launch));
        let mjpeg = Launch { mode: Mode::Mjpeg, ..launch.clone() };
        assert_eq!(text(&mjpeg), format!("{common}{rest}--stream=mjpeg{world}"));
        let xvfb = Launch { xvfb: true, ..launch };
        assert!(text(&xvfb).starts_with("xvfb-run|") && !text(&xvfb).contains("--auth-file"));
        let plain = Launch { instance: Path::new("/tmp/a"), ..xvfb };
        assert!(text(&plain).contains("|--auth-file|/tmp/a/Xauthority|/usr/local/webots/webots|"));
    }
}
