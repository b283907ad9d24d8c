//! Why the containers of a simulation could not be started.

use super::docker::DockerError;

/// Why the containers of a simulation could not be started, in words for the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StartError {
    /// The project is at fault: no other server could start it.
    #[error("{0}")]
    Project(String),
    /// This server is at fault, its Docker or its disk: another one may take the client.
    #[error("{0}")]
    Server(String),
}

impl From<String> for StartError {
    fn from(why: String) -> Self {
        Self::Project(why)
    }
}

impl From<DockerError> for StartError {
    fn from(error: DockerError) -> Self {
        Self::Server(error.to_string())
    }
}

impl From<std::io::Error> for StartError {
    fn from(error: std::io::Error) -> Self {
        Self::Server(format!("This simulation server can't write in its cache: {error}"))
    }
}
