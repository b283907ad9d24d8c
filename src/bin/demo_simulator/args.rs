//! The command line: Webots' options in any order, then the world file. Pure; `main` acts on the outcome.

use std::path::PathBuf;
use std::time::Duration;

use thiserror::Error;

use crate::clock::Mode;

/// The port of a simulator that was started without `--port`.
const DEFAULT_PORT: u16 = 1234;
/// The heartbeat of a plain `--heartbeat`.
const DEFAULT_HEARTBEAT: Duration = Duration::from_secs(1);

/// What a command line asks for.
#[derive(Debug, PartialEq)]
pub(crate) enum Request {
    /// Run a simulation.
    Run(Options),
    /// Print the version and end.
    Version,
    /// Print facts about this machine and end.
    SystemInfo,
    /// Print the usage and end.
    Help,
}

/// How to run a simulation.
#[derive(Debug, PartialEq)]
#[expect(clippy::struct_excessive_bools, reason = "each is an independent switch of the command line")]
pub(crate) struct Options {
    /// The world file.
    pub(crate) world: PathBuf,
    /// The first port to try; ten more follow.
    pub(crate) port: u16,
    /// The mode in which the simulation starts.
    pub(crate) mode: Mode,
    /// Whether clients can watch.
    pub(crate) stream: bool,
    /// Whether dialogs are off; streaming without it deserves a warning.
    pub(crate) batch: bool,
    /// The period of the `.` lines; none without.
    pub(crate) heartbeat: Option<Duration>,
    /// Whether the simulator's own remarks go to the standard output.
    pub(crate) stdout: bool,
    /// Whether warnings and errors go to the standard error.
    pub(crate) stderr: bool,
    /// Whether a mode was given by its deprecated name.
    pub(crate) deprecated_mode: bool,
}

/// A command line that cannot be followed.
#[derive(Debug, Error, PartialEq)]
pub(crate) enum ArgsError {
    /// An option that does not exist, or is written wrongly.
    #[error("invalid option '{0}': unknown or malformed.")]
    UnknownOption(String),
    /// An option whose value is out of its range.
    #[error("invalid value \"{value}\" to '{option}' option.")]
    InvalidValue {
        /// The option, with its dashes.
        option: &'static str,
        /// What was given.
        value: String,
    },
    /// A second world file.
    #[error("unexpected argument '{0}' after the world file.")]
    SecondWorld(String),
    /// No world file.
    #[error("a world file is needed.")]
    NoWorld,
}

/// Reads the arguments (without the program's name) from left to right; the first that ends the
/// program, such as `--version`, wins over whatever follows it.
pub(crate) fn parse(args: impl IntoIterator<Item = String>) -> Result<Request, ArgsError> {
    let mut world = None;
    let mut options = Options {
        world: PathBuf::new(),
        port: DEFAULT_PORT,
        mode: Mode::RealTime,
        stream: false,
        batch: false,
        heartbeat: None,
        stdout: false,
        stderr: false,
        deprecated_mode: false,
    };
    for arg in args {
        match arg.as_str() {
            "--version" => return Ok(Request::Version),
            "--sysinfo" => return Ok(Request::SystemInfo),
            "--help" => return Ok(Request::Help),
            option if option.starts_with('-') => options.set(option)?,
            _ if world.is_some() => return Err(ArgsError::SecondWorld(arg)),
            _ => world = Some(PathBuf::from(arg)),
        }
    }
    options.world = world.ok_or(ArgsError::NoWorld)?;
    Ok(Request::Run(options))
}

impl Options {
    fn set(&mut self, arg: &str) -> Result<(), ArgsError> {
        let (option, value) = match arg.split_once('=') {
            Some((option, value)) => (option, Some(value)),
            None => (arg, None),
        };
        match (option, value) {
            ("--batch", None) => self.batch = true,
            ("--stdout", None) => self.stdout = true,
            ("--stderr", None) => self.stderr = true,
            ("--minimize" | "--no-rendering" | "--fullscreen" | "--extern-urls", None)
            | ("--log-performance", Some(_)) => (), // nothing here has a window, a controller or a profile
            ("--mode", Some(value)) => self.set_mode(value)?,
            ("--port", Some(value)) => {
                let port = value.parse().ok().filter(|port| *port > 0);
                self.port = port.ok_or_else(|| invalid("--port", value))?;
            }
            ("--stream", None | Some("x3d" | "w3d" | "mjpeg")) => self.stream = true,
            ("--stream", Some(value)) => return Err(invalid("--stream", value)),
            ("--heartbeat", None) => self.heartbeat = Some(DEFAULT_HEARTBEAT),
            ("--heartbeat", Some(value)) => {
                let period = value.parse().ok().filter(|period| *period > 0);
                let period = period.ok_or_else(|| invalid("--heartbeat", value))?;
                self.heartbeat = Some(Duration::from_millis(period));
            }
            _ => return Err(ArgsError::UnknownOption(arg.to_owned())),
        }
        Ok(())
    }

    fn set_mode(&mut self, value: &str) -> Result<(), ArgsError> {
        self.mode = match value {
            "pause" | "stop" => Mode::Pause,
            "realtime" => Mode::RealTime,
            "fast" | "run" => Mode::Fast,
            _ => return Err(invalid("--mode", value)),
        };
        self.deprecated_mode = matches!(value, "stop" | "run");
        Ok(())
    }
}

fn invalid(option: &'static str, value: &str) -> ArgsError {
    ArgsError::InvalidValue { option, value: value.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_line(line: &str) -> Result<Request, ArgsError> {
        parse(line.split_whitespace().map(str::to_owned))
    }

    fn options(line: &str) -> Options {
        match parse_line(line) {
            Ok(Request::Run(options)) => options,
            other => panic!("{line}: {other:?}"),
        }
    }

    #[test]
    fn the_line_of_a_simulation_server_is_understood() {
        let options = options(
            "--batch --mode=pause --minimize --no-rendering --port=2001 --heartbeat=5000 --stream a/worlds/b.wbt",
        );
        assert_eq!(options.world, PathBuf::from("a/worlds/b.wbt"));
        assert_eq!(options.port, 2001);
        assert_eq!(options.mode, Mode::Pause);
        assert_eq!(options.heartbeat, Some(Duration::from_secs(5)));
        assert!(options.stream && options.batch && !options.stdout && !options.stderr);
    }

    #[test]
    fn options_may_come_in_any_order_and_have_defaults() {
        let options = options("w.wbt --stderr --heartbeat --stream=x3d --log-performance=f,10");
        assert_eq!(options.port, DEFAULT_PORT);
        assert_eq!(options.mode, Mode::RealTime);
        assert_eq!(options.heartbeat, Some(DEFAULT_HEARTBEAT));
        assert!(options.stream && options.stderr);
    }

    #[test]
    fn deprecated_mode_names_still_work() {
        for (name, mode) in [("stop", Mode::Pause), ("run", Mode::Fast)] {
            let options = options(&format!("--mode={name} w.wbt"));
            assert_eq!((options.mode, options.deprecated_mode), (mode, true));
        }
    }

    #[test]
    fn bad_options_are_refused_with_the_reason() {
        for (line, message) in [
            ("--nonsense w.wbt", "invalid option '--nonsense': unknown or malformed."),
            ("--batch=yes w.wbt", "invalid option '--batch=yes': unknown or malformed."),
            ("--port w.wbt", "invalid option '--port': unknown or malformed."),
            ("--port=0 w.wbt", "invalid value \"0\" to '--port' option."),
            ("--port=65536 w.wbt", "invalid value \"65536\" to '--port' option."),
            ("--stream=foo w.wbt", "invalid value \"foo\" to '--stream' option."),
            ("--mode=slow w.wbt", "invalid value \"slow\" to '--mode' option."),
            ("--heartbeat=0 w.wbt", "invalid value \"0\" to '--heartbeat' option."),
            ("--heartbeat=-5 w.wbt", "invalid value \"-5\" to '--heartbeat' option."),
            ("a.wbt b.wbt", "unexpected argument 'b.wbt' after the world file."),
            ("--batch", "a world file is needed."),
        ] {
            assert_eq!(parse_line(line).unwrap_err().to_string(), message, "{line}");
        }
    }

    #[test]
    fn options_that_end_the_program_win_over_what_follows() {
        assert_eq!(parse_line("--version --nonsense"), Ok(Request::Version));
        assert_eq!(parse_line("--sysinfo"), Ok(Request::SystemInfo));
        assert_eq!(parse_line("--batch --help"), Ok(Request::Help));
        assert!(parse_line("--nonsense --version").is_err());
    }
}
