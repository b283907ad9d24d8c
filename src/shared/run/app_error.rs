//! Why a server exits with an error.

use std::net::SocketAddr;
use std::path::PathBuf;

/// Why a server can't start, or can't continue.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The port is in use, or the system does not allow it.
    #[error("can't listen on {address}: {source}")]
    Bind {
        /// Host and port.
        address: SocketAddr,
        /// The error of the system.
        source: std::io::Error,
    },
    /// A directory of the configuration can't be used.
    #[error("the folder {} ({key}) can't be used: {source}", folder.display())]
    Folder {
        /// The key of the configuration.
        key: &'static str,
        /// The path of the directory.
        folder: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
    /// The limit of open files is too low.
    #[error(
        "{files} files may be open, which is not enough for {needed}; ulimit -Hn, or LimitNOFILE of systemd, allows more"
    )]
    NoClients {
        /// The limit of open files.
        files: u64,
        /// What the server needs at least.
        needed: String,
    },
    /// The configuration requires what this machine does not have.
    #[error("{0}")]
    Unavailable(String),
    /// Another error of the system.
    #[error(transparent)]
    System(#[from] std::io::Error),
    /// A metric has an invalid name.
    #[error(transparent)]
    Metrics(#[from] prometheus::Error),
    /// A permanent actor has stopped, which is a bug in this program.
    #[error("{0}")]
    ActorStopped(String),
}
