//! The program to launch.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::display::Display;

/// A program that is to be launched for a simulation.
pub struct Program<'start> {
    /// The program and its arguments.
    pub command: Vec<OsString>,
    /// The instance's directory.
    pub instance: &'start Path,
    /// The directory of its project, which is writable.
    pub project: PathBuf,
    /// The working directory.
    pub folder: &'start Path,
    /// The port that it is to stream on.
    pub port: u16,
    /// Its display.
    pub display: &'start Display,
    /// Variables of its own: the one that names its GPU.
    pub variables: Vec<(OsString, OsString)>,
    /// Time between SIGTERM and SIGKILL.
    pub grace: Duration,
}
