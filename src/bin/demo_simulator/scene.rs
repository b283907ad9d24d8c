//! The scene that clients see, prepared beside each world:
//!
//! | file | |
//! |---|---|
//! | `NAME.wbt` | the world; only its first line is read |
//! | `NAME.x3d` | the model, as it is sent to clients |
//! | `NAME.motion.json` | the step, the frame rate, and the motion of the model's robots |
//!
//! A world without a model is shown as what Webots has exported of it, if its project has that, as the competitions of
//! webots.cloud do:
//!
//! | file of the project | |
//! |---|---|
//! | `preview/scene.w3d`, or else `preview/scene.x3d` | the model, which is sent as it is |
//! | `preview/animation.json` | the motion, see `animation` |
//!
//! Otherwise it is shown as a small built-in scene, with the file's name as its title.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use askama::Template;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::animation::{Animation, AnimationError};
use crate::motion::{Pose, Robot};
use crate::robot_windows::{self, RobotWindow};

/// Size limit of a file, in bytes.
const MAX_FILE: u64 = 32 * 1024 * 1024;
const EMPTY_MODEL: &str = include_str!("../../../templates/demo/empty.x3d");
const DEFAULT_MOTION: &str = include_str!("../../../templates/demo/default.motion.json");

/// Why a prepared scene cannot be shown.
#[derive(Debug, Error)]
pub(crate) enum SceneError {
    #[error("cannot read '{}': {source}", path.display())]
    Unreadable { path: PathBuf, source: io::Error },
    #[error("the motion of the robots: {0}")]
    Motion(#[from] serde_json::Error),
    #[error("animation.json: {0}")]
    Animation(#[from] AnimationError),
    #[error("there is no '{}'", .0.display())]
    Missing(PathBuf),
}

/// The scene that clients see.
#[derive(Debug)]
pub(crate) struct Scene {
    /// The model, as XML.
    pub(crate) model: String,
    motion: Motion,
    /// The windows of its robots.
    pub(crate) windows: Vec<RobotWindow>,
}

#[derive(Debug)]
enum Motion {
    Circles(Circles),
    Recorded(Animation),
}

/// The motion of robots that drive in circles.
#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Circles {
    /// Length of a step, in milliseconds.
    #[serde(rename = "basicTimeStep")]
    basic_time_step: f64,
    /// Updates per second of wall time, at most.
    #[serde(rename = "FPS")]
    fps: f64,
    /// The robots, by name.
    robots: BTreeMap<String, Robot>,
}

#[derive(Template)]
#[template(path = "demo/default.x3d", escape = "html")]
struct DefaultModel<'a> {
    title: &'a str,
}

#[derive(Serialize)]
struct Update {
    time: serde_json::Number,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    updates: Vec<Pose>,
}

impl Default for Circles {
    fn default() -> Self {
        Self {
            basic_time_step: 32.0,
            fps: 60.0,
            robots: BTreeMap::new(),
        }
    }
}

impl Scene {
    /// Reads the scene of a world of `project`. Blocks.
    pub(crate) fn load(world: &Path, project: &Path) -> Result<Self, SceneError> {
        let scene = match read(&world.with_extension("x3d"))? {
            Some(model) => Self::prepared(world, &model)?,
            None => match Self::exported(&project.join("preview"))? {
                Some(scene) => scene,
                None => Self::built_in(world)?,
            },
        };
        let windows = robot_windows::of_world(world);
        Ok(Self { windows, ..scene })
    }

    fn prepared(world: &Path, model: &str) -> Result<Self, SceneError> {
        let circles = match read(&world.with_extension("motion.json"))? {
            Some(text) => serde_json::from_str(&text)?,
            None => Circles::default(),
        };
        Ok(Self {
            model: on_one_line(model),
            motion: Motion::Circles(circles),
            windows: Vec::new(),
        })
    }

    /// What Webots has exported to `folder`; `None` if that has no scene.
    fn exported(folder: &Path) -> Result<Option<Self>, SceneError> {
        let model = match read(&folder.join("scene.w3d"))? {
            None => read(&folder.join("scene.x3d"))?,
            model => model,
        };
        let Some(model) = model else { return Ok(None) };
        let path = folder.join("animation.json");
        let Some(animation) = read(&path)? else {
            return Err(SceneError::Missing(path));
        };
        Ok(Some(Self {
            model,
            motion: Motion::Recorded(Animation::parse(&animation)?),
            windows: Vec::new(),
        }))
    }

    fn built_in(world: &Path) -> Result<Self, SceneError> {
        let title: String = world
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .replace(char::is_control, "");
        let model = DefaultModel { title: &title }.to_string();
        Ok(Self {
            model: on_one_line(&model),
            motion: Motion::Circles(serde_json::from_str(DEFAULT_MOTION)?),
            windows: Vec::new(),
        })
    }

    /// The scene of a world that cannot be shown.
    pub(crate) fn empty() -> Self {
        Self {
            model: on_one_line(EMPTY_MODEL),
            motion: Motion::Circles(Circles::default()),
            windows: Vec::new(),
        }
    }

    /// Length of a step, in milliseconds.
    pub(crate) fn step(&self) -> f64 {
        match &self.motion {
            Motion::Circles(circles) => circles.basic_time_step.clamp(0.1, 10_000.0),
            Motion::Recorded(animation) => animation.step,
        }
    }

    /// Updates per second of wall time, at most.
    pub(crate) fn fps(&self) -> f64 {
        let fps = match &self.motion {
            Motion::Circles(circles) => circles.fps,
            Motion::Recorded(animation) => animation.fps(),
        };
        fps.clamp(1.0, 240.0)
    }

    /// Returns, as JSON, the state at `time`, in milliseconds.
    pub(crate) fn state(&self, time: f64) -> String {
        match &self.motion {
            Motion::Circles(circles) => circles.state(time),
            Motion::Recorded(animation) => animation.state(time),
        }
    }

    /// Returns, as JSON, what is sent of the time after `from` up to `to`, in milliseconds.
    pub(crate) fn updates(&self, from: f64, to: f64) -> Vec<String> {
        match &self.motion {
            Motion::Circles(circles) => vec![circles.state(to)],
            Motion::Recorded(animation) => animation.updates(from, to),
        }
    }
}

impl Circles {
    fn state(&self, time: f64) -> String {
        // via text, so that a whole number of milliseconds has no decimal point, as in Webots
        let number = time.to_string().parse().unwrap_or_else(|_| 0.into());
        let updates = self.robots.values().map(|robot| robot.pose(time)).collect();
        serde_json::to_string(&Update { time: number, updates }).unwrap_or_default()
    }
}

/// Returns a file's text; `None` if there is no such file.
fn read(path: &Path) -> Result<Option<String>, SceneError> {
    let unreadable = |source| SceneError::Unreadable {
        path: path.to_owned(),
        source,
    };
    let file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file.map_err(unreadable)?,
    };
    let mut text = String::new();
    let size = file.take(MAX_FILE + 1).read_to_string(&mut text).map_err(unreadable)?;
    if u64::try_from(size).is_ok_and(|size| size > MAX_FILE) {
        return Err(unreadable(io::ErrorKind::FileTooLarge.into()));
    }
    Ok(Some(text))
}

/// Webots sends models without indentation.
fn on_one_line(xml: &str) -> String {
    xml.lines().map(str::trim).collect()
}
