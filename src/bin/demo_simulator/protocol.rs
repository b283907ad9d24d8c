//! The texts that a client and the simulator exchange over a WebSocket. Pure; only this file contains them.
//!
//! | client sends | meaning |
//! |---|---|
//! | `w3d` since R2025a, `x3d` before, both also with `;broadcast` | send the scene; without `;broadcast` the simulation pauses at its next step unless the client runs it |
//! | `pause`, `step`, `reset`, `reload` (`revert`), `load:WORLD` | the command of that name |
//! | `real-time:MS`, `fast:MS` | run, and pause by itself after this much simulation time; never if negative |
//! | `timeout:MS` | change only that time |
//! | `robot:...` | for a controller; none runs here |
//!
//! The constants and functions below create what the simulator sends.

use crate::robot_windows::RobotWindow;
use crate::world::WorldNames;

/// A request of a client. Timeouts are in milliseconds of simulation time; infinite for never.
#[derive(Debug, PartialEq)]
pub(crate) enum Command {
    Watch { broadcast: bool },
    Pause,
    RealTime(f64),
    Fast(f64),
    Step,
    Reset,
    Reload,
    Load(String),
    Timeout(f64),
    Robot,
}

impl Command {
    /// Parses a client's text; `None` if it is not a request. `scene_request` is the one for the scene.
    pub(crate) fn parse(text: &str, scene_request: &str) -> Option<Self> {
        let command = match text {
            "pause" => Self::Pause,
            "step" => Self::Step,
            "reset" => Self::Reset,
            "reload" | "revert" => Self::Reload,
            _ if text.starts_with(scene_request) => Self::Watch {
                broadcast: text.ends_with(";broadcast"),
            },
            _ => match text.split_once(':')? {
                ("real-time", timeout) => Self::RealTime(parse_timeout(timeout)?),
                ("fast", timeout) => Self::Fast(parse_timeout(timeout)?),
                ("timeout", timeout) => Self::Timeout(parse_timeout(timeout)?),
                ("load", world) => Self::Load(world.trim().to_owned()),
                ("robot", _) => Self::Robot,
                _ => return None,
            },
        };
        Some(command)
    }
}

fn parse_timeout(text: &str) -> Option<f64> {
    let timeout: f64 = text.trim().parse().ok()?;
    timeout
        .is_finite()
        .then_some(if timeout < 0.0 { f64::INFINITY } else { timeout })
}

/// Answers `pause` and `step`.
pub(crate) const PAUSED_BY_CLIENT: &str = "paused by client";
/// The state of a simulation in real time; also answers `real-time:`.
pub(crate) const REAL_TIME: &str = "real-time";
/// The state of a fast simulation; also answers `fast:`.
pub(crate) const FAST: &str = "fast";
/// The last answer to `reset`.
pub(crate) const RESET_FINISHED: &str = "reset finished";
/// The last part of a scene.
pub(crate) const SCENE_COMPLETED: &str = "scene load completed";
/// Answers a controller, before it is closed, while there is no world.
pub(crate) const PROCESSING: &str = "PROCESSING";
/// Answers a controller whose robot is not there.
pub(crate) const FAILED: &str = "FAILED";
/// The status of a world whose assets are downloaded.
pub(crate) const DOWNLOADING: &str = "Downloading assets";
/// The first status of a world that is being read; with the trailing space, as in Webots.
pub(crate) const READING: &str = "Reading world file ";
/// Announces that another world will be loaded.
pub(crate) const DELETE_WORLD: &str = "delete world";

/// The state of a paused simulation, at `time` milliseconds.
pub(crate) fn paused(time: f64) -> String {
    format!("pause: {time}")
}

/// A warning or an error of the console.
pub(crate) fn stderr(line: &str) -> String {
    format!("stderr:{line}")
}

/// The progress of loading a world.
pub(crate) fn loading(status: &str, percent: u8) -> String {
    format!("loading:{status}:{percent}")
}

/// The world that is simulated, and all worlds of the project.
pub(crate) fn world(names: &WorldNames) -> String {
    format!("world:{}:{}", names.current, names.all.join(";"))
}

/// The scene.
pub(crate) fn model(xml: &str) -> String {
    format!("model:{xml}")
}

/// The window of a robot.
pub(crate) fn robot_window(window: &RobotWindow) -> String {
    format!("robot window: {}", serde_json::json!(window))
}

/// An update of the scene.
pub(crate) fn update(json: &str) -> String {
    format!("application/json:{json}")
}
