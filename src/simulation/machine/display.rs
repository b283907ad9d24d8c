//! The X display on which Webots opens its window: its name, and whether one answers there.

use std::io;
use std::net::ToSocketAddrs;
use std::path::PathBuf;
use std::time::Duration;

use socket2::{SockAddr, Socket, Type};

/// Timeout of a connection.
const ANSWER: Duration = Duration::from_secs(2);
/// TCP port of display 0; display N has this port + N.
const FIRST_PORT: u16 = 6000;

/// The host of a display with this name, and its number.
fn parse(name: &str) -> Option<(&str, u16)> {
    let (host, numbers) = name.rsplit_once(':')?;
    let (number, _screen) = numbers.split_once('.').unwrap_or((numbers, "0"));
    Some((
        host,
        number.parse().ok().filter(|number| *number <= u16::MAX - FIRST_PORT)?,
    ))
}

/// The socket of a display of this machine; `None` if it is reached by TCP.
pub fn socket(display: &str) -> Option<PathBuf> {
    let (host, number) = parse(display)?;
    matches!(host, "" | "unix").then(|| format!("/tmp/.X11-unix/X{number}").into())
}

/// The display to use: the configured one, else that of the environment variable `DISPLAY`, else `:0`.
pub fn effective(configured: Option<&String>) -> String {
    let of_environment = || std::env::var("DISPLAY").ok().filter(|display| !display.is_empty());
    configured
        .cloned()
        .or_else(of_environment)
        .unwrap_or_else(|| ":0".to_owned())
}

/// Checks that a display answers, not whether it admits this user. Blocks for at most two seconds per address.
///
/// # Errors
/// Why Webots can't open its window there, and what to do about it.
pub fn check(display: &str) -> Result<(), String> {
    let (host, number) =
        parse(display).ok_or_else(|| format!("{display:?} is no display; allowed is HOST:NUMBER or :NUMBER"))?;
    let connected = match socket(display) {
        // Not the abstract socket of that name: any user can create it, and a sandbox can't reach it.
        Some(path) => reach(SockAddr::unix(path)),
        None => (host, FIRST_PORT + number).to_socket_addrs().and_then(|mut all| {
            let any = all.find_map(|address| reach(Ok(address.into())).ok());
            any.ok_or_else(|| io::ErrorKind::TimedOut.into())
        }),
    };
    connected.map_err(|_| {
        format!(
            "no display answers at {display}: start an X server there (without a monitor: Xvfb, or Xorg after \
             nvidia-xconfig --allow-empty-initial-configuration), or set xvfb: true in the server's configuration"
        )
    })
}

fn reach(address: io::Result<SockAddr>) -> io::Result<()> {
    let address = address?;
    Socket::new(address.domain(), Type::STREAM, None)?.connect_timeout(&address, ANSWER)
}
