//! Why a server ends with an error.

use std::net::SocketAddr;
use std::path::PathBuf;

/// Why a server can't start, or can't go on.
#[derive(Debug, thiserror::Error)]
pub enum AppError {
    /// The port is taken, or the system does not allow it.
    #[error("can't listen on {address}: {source}")]
    Bind {
        /// Host and port.
        address: SocketAddr,
        /// What the system says.
        source: std::io::Error,
    },
    /// A folder of the configuration can't be used.
    #[error("the folder {} ({key}) can't be used: {source}", folder.display())]
    Folder {
        /// The key of the configuration.
        key: &'static str,
        /// The folder.
        folder: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The limit of open files is too low.
    #[error(
        "{files} files may be open, which is not enough for {needed}; ulimit -Hn, or LimitNOFILE of systemd, allows more"
    )]
    NoClients {
        /// The limit of open files.
        files: u64,
        /// What at least must be possible.
        needed: String,
    },
    /// What the configuration asks for can't be had on this machine.
    #[error("{0}")]
    Unavailable(String),
    /// Another error of the system.
    #[error(transparent)]
    System(#[from] std::io::Error),
    /// A metric has an invalid name.
    #[error(transparent)]
    Metrics(#[from] prometheus::Error),
    /// An actor that must live has stopped. This is a fault in this program.
    #[error("{0}")]
    ActorStopped(String),
}
