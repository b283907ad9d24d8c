//! The X display that Webots opens its window on: which one, and whether it answers.

use std::net::{TcpStream, ToSocketAddrs};
use std::os::unix::net::UnixStream;
use std::time::Duration;

/// How long a display on another machine may take to answer.
const PATIENCE: Duration = Duration::from_secs(1);
/// The port of display 0; the others follow.
const FIRST_PORT: u16 = 6000;
/// Where the sockets of local displays are.
const SOCKETS: &str = "/tmp/.X11-unix/X";

/// The display that is used where none is configured: the server's own, else the first.
#[must_use]
pub fn effective(configured: Option<&str>) -> String {
    let own = || std::env::var("DISPLAY").ok().filter(|display| !display.is_empty());
    configured.map(str::to_owned).or_else(own).unwrap_or_else(|| ":0".to_owned())
}

/// Splits `HOST:NUMBER.SCREEN` into host and number; a local display has no host.
fn parse(display: &str) -> Option<(&str, u16)> {
    let (host, number) = display.rsplit_once(':')?;
    let number = number.split('.').next().unwrap_or_default();
    let host = if host == "unix" { "" } else { host };
    number.parse().ok().map(|number| (host, number))
}

/// Whether somebody answers at a display. Waits up to a second: not for a thread that serves others.
#[must_use]
pub fn answers(display: &str) -> bool {
    let Some((host, number)) = parse(display) else {
        return false;
    };
    if host.is_empty() {
        let path = format!("{SOCKETS}{number}");
        // Servers on Linux may have only the abstract socket of the same name.
        return UnixStream::connect(&path).is_ok() || abstract_answers(&path);
    }
    let addresses = (host, FIRST_PORT.saturating_add(number)).to_socket_addrs();
    addresses.into_iter().flatten().any(|address| TcpStream::connect_timeout(&address, PATIENCE).is_ok())
}

#[cfg(target_os = "linux")]
fn abstract_answers(path: &str) -> bool {
    use std::os::linux::net::SocketAddrExt;
    let address = std::os::unix::net::SocketAddr::from_abstract_name(path);
    address.is_ok_and(|address| UnixStream::connect_addr(&address).is_ok())
}

#[cfg(not(target_os = "linux"))]
fn abstract_answers(_: &str) -> bool {
    false
}

/// What to do about a display that does not answer.
#[must_use]
pub fn hint(display: &str) -> String {
    format!("no display answers at {display}: start an X server there, or set xvfb: true in the server's configuration")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn displays_are_read() {
        let table = [
            (":0", Some(("", 0))),
            (":12.1", Some(("", 12))),
            ("unix:3", Some(("", 3))),
            ("host.lab:1.0", Some(("host.lab", 1))),
            ("", None),
            ("0", None),
            (":x", None),
        ];
        for (text, display) in table {
            assert_eq!(parse(text), display, "{text}");
        }
    }

    #[test]
    fn a_display_answers_where_somebody_listens() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        if port > FIRST_PORT {
            assert!(answers(&format!("127.0.0.1:{}", port - FIRST_PORT)));
        }
        assert!(!answers(":59999") && !answers("nonsense"));
    }
}
