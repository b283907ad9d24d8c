//! The texts that a viewer and the simulator exchange over a WebSocket. Pure; wire strings live only here.
//!
//! | viewer says | meaning |
//! |---|---|
//! | `x3d`, `w3d`, both also with `;broadcast` | send the scene and then what moves; without `;broadcast` the simulation pauses at its next step unless the viewer runs it |
//! | `mjpeg: WxH` | send pictures (refused: nothing is rendered here) |
//! | `pause`, `step`, `reset`, `reload` (`revert`), `load:WORLD` | do so |
//! | `real-time:MS`, `fast:MS` | run, and pause by itself after so much simulation time; never if negative |
//! | `timeout:MS` | change that time only |
//! | `robot:...` | for a controller; none runs here |
//!
//! The functions below make what the simulator says.

use crate::world::Names;

/// What a viewer asks for.
#[derive(Debug, PartialEq)]
pub(crate) enum Command {
    /// To see the scene.
    Watch {
        /// Whether it only looks on.
        broadcast: bool,
    },
    /// To see pictures.
    WatchPictures,
    /// To stop time.
    Pause,
    /// To run in real time, until the timeout in milliseconds.
    RealTime(f64),
    /// To run fast, until the timeout in milliseconds.
    Fast(f64),
    /// To make one step.
    Step,
    /// To go back to time 0.
    Reset,
    /// To read the world file again.
    Reload,
    /// To change to another world of the project.
    Load(String),
    /// To change the timeout, in milliseconds.
    Timeout(f64),
    /// To tell a controller something.
    Robot,
}

impl Command {
    /// Reads a viewer's text; `None` if it means nothing.
    pub(crate) fn parse(text: &str) -> Option<Self> {
        let command = match text {
            "pause" => Self::Pause,
            "step" => Self::Step,
            "reset" => Self::Reset,
            "reload" | "revert" => Self::Reload,
            _ if text.starts_with("x3d") || text.starts_with("w3d") => {
                Self::Watch { broadcast: text.ends_with(";broadcast") }
            }
            _ => match text.split_once(':')? {
                ("real-time", timeout) => Self::RealTime(parse_timeout(timeout)?),
                ("fast", timeout) => Self::Fast(parse_timeout(timeout)?),
                ("timeout", timeout) => Self::Timeout(parse_timeout(timeout)?),
                ("load", world) => Self::Load(world.trim().to_owned()),
                ("robot", _) => Self::Robot,
                ("mjpeg", _) => Self::WatchPictures,
                _ => return None,
            },
        };
        Some(command)
    }
}

/// A negative timeout is never reached.
fn parse_timeout(text: &str) -> Option<f64> {
    let timeout: f64 = text.trim().parse().ok()?;
    let is_number = timeout.is_finite();
    is_number.then_some(if timeout < 0.0 { f64::INFINITY } else { timeout })
}

/// Answers `pause` and `step`.
pub(crate) const PAUSED_BY_CLIENT: &str = "paused by client";
/// The state of a simulation in real time; also answers `real-time:`.
pub(crate) const REAL_TIME: &str = "real-time";
/// The state of a fast simulation; also answers `fast:`.
pub(crate) const FAST: &str = "fast";
/// Ends what follows a `reset`.
pub(crate) const RESET_FINISHED: &str = "reset finished";
/// Ends the scene.
pub(crate) const SCENE_COMPLETED: &str = "scene load completed";
/// Another world is about to come.
pub(crate) const DELETE_WORLD: &str = "delete world";

/// The state of a paused simulation, at `time` milliseconds.
pub(crate) fn paused(time: f64) -> String {
    format!("pause: {time}")
}

/// How far a world has been loaded.
pub(crate) fn loading(status: &str, percent: u8) -> String {
    format!("loading:{status}:{percent}")
}

/// The world that is simulated, and those that could be.
pub(crate) fn world(names: &Names) -> String {
    format!("world:{}:{}", names.current, names.all.join(";"))
}

/// The scene.
pub(crate) fn model(xml: &str) -> String {
    format!("model:{xml}")
}

/// An update of the scene.
pub(crate) fn update(json: &str) -> String {
    format!("application/json:{json}")
}

/// A node that is to be visible again.
pub(crate) fn visible(id: u32) -> String {
    format!("visibility:{id}:1")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_viewers_say_is_understood_byte_for_byte() {
        for (text, command) in [
            ("x3d", Some(Command::Watch { broadcast: false })),
            ("w3d;broadcast", Some(Command::Watch { broadcast: true })),
            ("mjpeg: 800x600;broadcast", Some(Command::WatchPictures)),
            ("pause", Some(Command::Pause)),
            ("pause ", None),
            ("real-time:-1", Some(Command::RealTime(f64::INFINITY))),
            ("real-time:300000", Some(Command::RealTime(300_000.0))),
            ("real-time:", None),
            ("fast:0", Some(Command::Fast(0.0))),
            ("fast:NaN", None),
            ("timeout:1.5", Some(Command::Timeout(1.5))),
            ("step", Some(Command::Step)),
            ("reset", Some(Command::Reset)),
            ("reload", Some(Command::Reload)),
            ("revert", Some(Command::Reload)),
            ("load:b.wbt", Some(Command::Load("b.wbt".to_owned()))),
            ("robot:{\"name\":\"a\",\"message\":\"b\"}", Some(Command::Robot)),
            ("run", None),
            ("", None),
        ] {
            assert_eq!(Command::parse(text), command, "{text}");
        }
    }

    #[test]
    fn what_the_simulator_says_is_byte_for_byte_what_viewers_expect() {
        let [a, b] = ["worlds/a.wbt", "worlds/b.wbt"].map(str::to_owned);
        let names = Names { current: a.clone(), all: vec![a, b] };
        assert_eq!(world(&names), "world:worlds/a.wbt:worlds/a.wbt;worlds/b.wbt");
        assert_eq!(paused(1024.0), "pause: 1024");
        assert_eq!(loading("Parsing world", 100), "loading:Parsing world:100");
        assert_eq!(update("{}"), "application/json:{}");
        assert_eq!(visible(7), "visibility:7:1");
        assert_eq!(model("<X3D/>"), "model:<X3D/>");
    }
}
