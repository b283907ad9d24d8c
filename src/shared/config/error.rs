//! The errors of a configuration file. Each is one line. Pure.

use std::path::PathBuf;

/// Why a configuration can't be used, in one line.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file can't be read.
    #[error("{}: can't be read: {source}", file.display())]
    Unreadable {
        /// The configuration file.
        file: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The text does not begin with a brace.
    #[error("{}: it is not a JSON object; allowed is {{\"KEY\": VALUE, ...}}", file.display())]
    NotAnObject {
        /// The configuration file.
        file: PathBuf,
    },
    /// The text is not JSON, or a key is missing, or the value of one is not allowed.
    #[error("{}: {}{problem}", file.display(), key.as_ref().map(|key| format!("{key}: ")).unwrap_or_default())]
    Malformed {
        /// The configuration file.
        file: PathBuf,
        /// The key, where the error is in the value of one.
        key: Option<String>,
        /// What was found and what is allowed.
        problem: String,
    },
    /// A value contradicts others.
    #[error("{}: {key}: {problem}", file.display())]
    InvalidValue {
        /// The configuration file.
        file: PathBuf,
        /// The key.
        key: &'static str,
        /// What was found and what is allowed.
        problem: String,
    },
}
