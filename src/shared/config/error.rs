//! The error of a configuration file. Pure.

use std::path::PathBuf;

/// Why a configuration is invalid, in one line.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", file.display())]
pub struct ConfigError {
    /// The configuration file.
    pub file: PathBuf,
    /// The key, if it is the value of one; what was found, and what is allowed.
    pub problem: String,
}
