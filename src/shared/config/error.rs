//! What can be wrong with a configuration file, each in one line. Pure.

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
    /// The text does not begin as a JSON object does.
    #[error("{}: it is no JSON object; allowed is {{\"KEY\": VALUE, ...}}", file.display())]
    NoObject {
        /// The configuration file.
        file: PathBuf,
    },
    /// The text is no JSON, or a key is missing or of the wrong type.
    #[error("{}: {}{source}", file.display(), key.as_ref().map(|key| format!("{key}: ")).unwrap_or_default())]
    Malformed {
        /// The configuration file.
        file: PathBuf,
        /// The key, where the fault lies in one.
        key: Option<String>,
        /// What was found and what is allowed.
        source: serde_json::Error,
    },
    /// A value doesn't fit the others.
    #[error("{}: {key}: {problem}", file.display())]
    Unfit {
        /// The configuration file.
        file: PathBuf,
        /// The key.
        key: &'static str,
        /// What was found and what is allowed.
        problem: String,
    },
}
