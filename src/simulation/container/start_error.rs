//! Why the containers of a simulation could not be started.

use super::docker::DockerError;

/// The cause, as text for the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StartError {
    /// The project is the cause: no other server could start it.
    #[error("{0}")]
    Project(String),
    /// This server is the cause, its Docker or its disk: another one may accept the client.
    #[error("{0}")]
    Server(String),
}

/// The cause if Docker fails with the containers of a simulation. `is_projects` tells whether the project has defined
/// one of their images: then the project is the cause, unless the disk is full.
pub fn blame(is_projects: bool, error: DockerError) -> StartError {
    match &error {
        DockerError::Failed { message, .. } if is_projects && !is_disk_full(message) => {
            StartError::Project(error.to_string())
        }
        _ => error.into(),
    }
}

/// Whether Docker reports a full disk. Only the end of the message counts, because it may contain names of the project.
pub fn is_disk_full(message: &str) -> bool {
    message.ends_with("no space left on device")
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

impl From<tokio::task::JoinError> for StartError {
    fn from(error: tokio::task::JoinError) -> Self {
        Self::Server(error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_docker_answers_about_a_projects_image_is_the_projects_fault() {
        let failed =
            |message: &str| DockerError::Failed { command: "docker cp".to_owned(), message: message.to_owned() };
        let is_own = |error| matches!(blame(true, error), StartError::Server(_));
        assert!(!is_own(failed("mknod /x: operation not permitted")));
        assert!(!is_own(failed("no space left on device: no such file")));
        assert!(is_own(failed("write /x: no space left on device")));
        assert!(is_own(DockerError::Unavailable("refused".to_owned())));
    }
}
