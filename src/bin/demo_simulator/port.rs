//! Finds the port to listen on: the one asked for, or one of the next ten.

use std::env;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};

use thiserror::Error;

use crate::console::Console;

/// Ports tried after the first.
const MORE_PORTS: u16 = 10;
/// The environment variable with the address to listen on; all of the machine's without.
const BIND_VARIABLE: &str = "DEMO_SIMULATOR_BIND";

/// Why the simulator cannot listen.
#[derive(Debug, Error)]
pub(crate) enum BindError {
    /// No port is free.
    #[error("failed to open TCP server in the port range [{first}-{last}]: {source}")]
    NoPort {
        /// The first port tried.
        first: u16,
        /// The last port tried.
        last: u16,
        /// Why the last one failed.
        source: io::Error,
    },
    /// The environment names no address.
    #[error("{BIND_VARIABLE} must be an IP address, not {0:?}")]
    Address(String),
}

/// Listens on `first` or one of the ports after it.
pub(crate) fn listen(first: u16, console: Console) -> Result<TcpListener, BindError> {
    let address = bind_address()?;
    let last = first.saturating_add(MORE_PORTS);
    let mut source = io::Error::from(io::ErrorKind::AddrInUse);
    for port in first..=last {
        match TcpListener::bind(SocketAddr::new(address, port)) {
            Ok(listener) => {
                if port != first {
                    console.warning(format_args!("Could not listen to port {first}. Using port {port} instead."));
                }
                console.info(format_args!("Streaming server listening on port {port}."));
                return Ok(listener);
            }
            Err(error) => source = error,
        }
    }
    Err(BindError::NoPort { first, last, source })
}

fn bind_address() -> Result<IpAddr, BindError> {
    match env::var(BIND_VARIABLE) {
        Ok(text) => text.parse().map_err(|_| BindError::Address(text)),
        Err(_) => Ok(IpAddr::V4(Ipv4Addr::UNSPECIFIED)),
    }
}
