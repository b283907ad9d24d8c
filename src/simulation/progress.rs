//! The progress of a start: what is done, and how far it is. Pure.

use serde::Serialize;

/// What a start does at the moment: a stable code.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Step {
    /// The remote is queried.
    Search,
    /// git fetches.
    Fetch,
    /// git writes the files.
    Write,
    /// The checkout is done.
    Done,
    /// An image is fetched or built, or its project read.
    Image,
    /// Webots is launched.
    Launch,
    /// Webots loads the world.
    Load,
}

/// Progress, as it is shown to a client.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Progress {
    /// What is done.
    pub step: Step,
    /// How much of it, in percent, if that is known.
    pub percent: Option<u8>,
    /// The same as text, in English.
    pub text: String,
    /// The number of the step and that of all steps, by which Webots' page moves its progress bar.
    pub of_all: Option<(u64, u64)>,
}

impl Progress {
    /// A step of which neither a percentage nor a number is known.
    pub fn new(step: Step, text: impl Into<String>) -> Self {
        Self {
            step,
            percent: None,
            text: text.into(),
            of_all: None,
        }
    }
}

/// Receives the progress of a job.
pub type OnProgress<'job> = &'job (dyn Fn(Progress) + Send + Sync);

/// The largest number of steps that Webots' page understands: each number has one digit.
pub const MAX_STEPS: u64 = 9;
