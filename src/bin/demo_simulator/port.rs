//! The port to listen on: the requested one, or one of the ten after it.

use std::env;
use std::error::Error;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};

use crate::console::Console;

/// Number of ports that are tried after the first.
const MORE_PORTS: u16 = 10;
/// The environment variable with the address to listen on; by default, all IPv4 addresses.
const BIND_VARIABLE: &str = "DEMO_SIMULATOR_BIND";

/// Listens on `first` or one of the ports after it.
pub(crate) fn listen(first: u16, console: Console) -> Result<TcpListener, Box<dyn Error>> {
    let address = bind_address()?;
    let last = first.saturating_add(MORE_PORTS);
    let mut reason = io::Error::from(io::ErrorKind::AddrInUse);
    for port in first..=last {
        match TcpListener::bind(SocketAddr::new(address, port)) {
            Ok(listener) => {
                if port != first {
                    console.trouble(&format!(
                        "WARNING: Could not listen to port {first}. Using port {port} instead."
                    ));
                }
                console.info(format_args!("Streaming server listening on port {port}."));
                return Ok(listener);
            }
            Err(error) => reason = error,
        }
    }
    Err(format!("failed to open TCP server in the port range [{first}-{last}]: {reason}").into())
}

fn bind_address() -> Result<IpAddr, String> {
    match env::var(BIND_VARIABLE) {
        Ok(text) => text
            .parse()
            .map_err(|_| format!("{BIND_VARIABLE} must be an IP address, not {text:?}")),
        Err(_) => Ok(IpAddr::V4(Ipv4Addr::UNSPECIFIED)),
    }
}
