//! The X display on which Webots opens its window: its name, and whether this user may connect to it.

use std::sync::mpsc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use x11rb::errors::ConnectError;
use x11rb::reexports::x11rb_protocol::parse_display::parse_display;
use x11rb::rust_connection::RustConnection;

/// Timeout of a display's answer.
const ANSWER: Duration = Duration::from_secs(2);
/// The highest display number: display N listens on port 6000 + N.
const LAST_NUMBER: u16 = u16::MAX - 6000;

/// Why Webots can't open its window on a display.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DisplayError {
    /// The name of the display is malformed.
    #[error("{0:?} is no display; allowed is HOST:NUMBER or :NUMBER")]
    BadName(String),
    /// No X server listens there.
    #[error(
        "no display answers at {0}: start an X server there (without a monitor: Xvfb, or Xorg after nvidia-xconfig \
         --allow-empty-initial-configuration), or set xvfb: true in the server's configuration"
    )]
    NoServer(String),
    /// The X server refuses this user.
    #[error(
        "the display {display} refuses this user ({reason}): run 'xhost +si:localuser:{user}' as its owner, or let \
         the environment variable XAUTHORITY name its authority file"
    )]
    Refused {
        /// The name of the display.
        display: String,
        /// The reason of the X server.
        reason: String,
        /// The user of this server.
        user: String,
    },
    /// The program that listens there does not answer, or does not use the X protocol.
    #[error("what is at {display} does not answer as a display does: {reason}")]
    Strange {
        /// The name of the display.
        display: String,
        /// The problem.
        reason: String,
    },
}

/// The name of a display, such as `:0`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct DisplayName(String);

impl TryFrom<String> for DisplayName {
    type Error = DisplayError;

    fn try_from(name: String) -> Result<Self, DisplayError> {
        if parse_display(Some(&name)).is_ok_and(|parsed| parsed.display <= LAST_NUMBER) {
            Ok(Self(name))
        } else {
            Err(DisplayError::BadName(name))
        }
    }
}

/// The display to use: the configured one, else that of the environment variable `DISPLAY`, else `:0`.
pub fn effective(configured: Option<&DisplayName>) -> String {
    configured.map(|display| display.0.clone()).or_else(of_environment).unwrap_or_else(|| ":0".to_owned())
}

/// The display in the environment variable `DISPLAY`.
pub fn of_environment() -> Option<String> {
    std::env::var("DISPLAY").ok().filter(|display| !display.is_empty())
}

/// Connects to a display as Webots would. Blocks for two seconds at most.
///
/// # Errors
/// Why Webots can't open its window there, and what to do about it.
pub fn check(display: &str) -> Result<(), DisplayError> {
    DisplayName::try_from(display.to_owned())?;
    let strange = |reason| DisplayError::Strange { display: display.to_owned(), reason };
    let (name, (sender, answer)) = (display.to_owned(), mpsc::channel());
    // A connection has no time limit of its own.
    let asking = move || sender.send(RustConnection::connect(Some(&name)).map(drop));
    let thread = std::thread::Builder::new().name("display".to_owned()).spawn(asking);
    thread.map_err(|error| strange(format!("no thread can be started to ask it: {error}")))?;
    let answer = answer.recv_timeout(ANSWER);
    answer
        .map_err(|_| strange(format!("it is silent for {} s", ANSWER.as_secs())))?
        .map_err(|error| explain(display, error))
}

fn explain(display: &str, error: ConnectError) -> DisplayError {
    let display = display.to_owned();
    let refused = |reason: &[u8]| {
        let reason = String::from_utf8_lossy(reason).trim().to_owned();
        DisplayError::Refused { display: display.clone(), reason, user: user() }
    };
    match error {
        ConnectError::SetupFailed(setup) => refused(&setup.reason),
        ConnectError::SetupAuthenticate(setup) => refused(&setup.reason),
        ConnectError::DisplayParsingError(_) => DisplayError::BadName(display),
        ConnectError::IoError(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
            DisplayError::Strange { display, reason: "it has closed the connection".to_owned() }
        }
        ConnectError::IoError(_) => DisplayError::NoServer(display),
        other => DisplayError::Strange { display, reason: other.to_string() },
    }
}

fn user() -> String {
    let own = nix::unistd::getuid();
    nix::unistd::User::from_uid(own).ok().flatten().map_or_else(|| format!("#{own}"), |user| user.name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn something_else_than_a_display_is_told() {
        use std::io::Read;
        // Displays on other machines are at 6000 and the ports that follow.
        let listener =
            (20_000..30_000u16).find_map(|port| std::net::TcpListener::bind(("127.0.0.1", port)).ok()).unwrap();
        let display = format!("127.0.0.1:{}", listener.local_addr().unwrap().port() - 6000);
        let silent = std::thread::spawn(move || {
            let (mut first, _) = listener.accept().unwrap();
            first.read_exact(&mut [0; 12]).unwrap();
            drop(first);
            let (mut second, _) = listener.accept().unwrap();
            second.read_to_end(&mut Vec::new()).ok();
        });
        let strange = |reason: &str| Err(DisplayError::Strange { display: display.clone(), reason: reason.to_owned() });
        assert_eq!(check(&display), strange("it has closed the connection"));
        assert_eq!(check(&display), strange("it is silent for 2 s"));
        drop(silent);
    }
}
