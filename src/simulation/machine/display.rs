//! The X display on which Webots opens its window: its name, and whether this user may connect to it.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{IpAddr, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sysinfo::System;

use crate::shared::text::one_line;

/// Timeout of a display's answer.
const ANSWER: Duration = Duration::from_secs(2);
/// Display N listens on this port + N, where it is reached by TCP.
const FIRST_PORT: u16 = 6000;
/// The only authorization method that all programs and displays know.
pub const COOKIE: &str = "MIT-MAGIC-COOKIE-1";
/// In an authority file: the entry counts for every host. `FamilyWild` of X11/Xauth.h.
pub const EVERY_HOST: u16 = 0xffff;
/// The entry counts for the host of this name, reached without TCP (`FamilyLocal`); or for an address of either version of
/// IP.
const NAMED_HOST: u16 = 256;
const IP: [u16; 2] = [0, 6];

/// The name of a display, such as `:0`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct DisplayName(String);

impl TryFrom<String> for DisplayName {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        if parse(&name).is_some() { Ok(Self(name)) } else { Err(malformed(&name)) }
    }
}

fn malformed(name: &str) -> String {
    format!("{name:?} is no display; allowed is HOST:NUMBER or :NUMBER")
}

/// The host of a display with this name, its number and its screen.
fn parse(name: &str) -> Option<(&str, u16, u8)> {
    let (host, numbers) = name.rsplit_once(':')?;
    let (number, screen) = numbers.split_once('.').unwrap_or((numbers, "0"));
    let number = number.parse().ok().filter(|number| *number <= u16::MAX - FIRST_PORT)?;
    Some((host, number, screen.parse().ok()?))
}

/// The socket of a display of this machine; `None` if it is reached by TCP.
pub fn socket(display: &str) -> Option<PathBuf> {
    let (host, number, _) = parse(display)?;
    matches!(host, "" | "unix").then(|| format!("/tmp/.X11-unix/X{number}").into())
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
pub fn check(display: &str) -> Result<(), String> {
    let (_, _, screen) = parse(display).ok_or_else(|| malformed(display))?;
    let strange = |reason: &str| format!("what is at {display} does not answer as a display does: {reason}");
    let (name, (sender, answer)) = (display.to_owned(), mpsc::channel());
    // To connect may take longer.
    let thread = std::thread::Builder::new().name("display".to_owned()).spawn(move || sender.send(connect(&name)));
    thread.map_err(|error| strange(&format!("no thread can be started to ask it: {error}")))?;
    let answer = answer.recv_timeout(ANSWER);
    match answer.map_err(|_| strange(&format!("it is silent for {} s", ANSWER.as_secs())))? {
        Ok(Ok(screens)) if screen < screens => Ok(()),
        Ok(Ok(screens)) => Err(strange(&format!("it has no screen {screen}, but {screens} from 0 on"))),
        Ok(Err(reason)) => Err(format!(
            "the display {display} refuses this user ({reason}): run 'xhost +si:localuser:{}' as its owner, or let the \
             environment variable XAUTHORITY name its authority file",
            user()
        )),
        Err(error) if error.kind() == ErrorKind::UnexpectedEof => Err(strange("it has closed the connection")),
        Err(error) if error.kind() == ErrorKind::InvalidData => Err(strange("it speaks another protocol")),
        Err(_) => Err(format!(
            "no display answers at {display}: start an X server there (without a monitor: Xvfb, or Xorg after \
             nvidia-xconfig --allow-empty-initial-configuration), or set xvfb: true in the server's configuration"
        )),
    }
}

/// Connects to a display. Returns how many screens it has, or why it refuses this user.
fn connect(display: &str) -> io::Result<Result<u8, String>> {
    let (host, number, _) = parse(display).ok_or(ErrorKind::InvalidInput)?;
    if let Some(path) = socket(display) {
        // Not at the abstract address of that name, which anybody can take, and which a sandbox does not have.
        let stream = UnixStream::connect(path)?;
        // A display that hangs must not keep the thread.
        stream.set_read_timeout(Some(ANSWER))?;
        return greet(stream, &cookie(None, number));
    }
    let stream = TcpStream::connect((host, FIRST_PORT + number))?;
    stream.set_read_timeout(Some(ANSWER))?;
    let peer = Some(stream.peer_addr()?.ip()).filter(|address| !address.is_loopback());
    greet(stream, &cookie(peer, number))
}

/// Begins the X protocol, with this cookie unless it is empty. See "Connection Setup" there.
fn greet(mut stream: impl Read + Write, cookie: &[u8]) -> io::Result<Result<u8, String>> {
    let fields = [if cookie.is_empty() { "" } else { COOKIE }.as_bytes(), cookie];
    // Of each number the lowest byte comes first (`l`), and this is version 11.0.
    let mut request = vec![b'l', 0, 11, 0, 0, 0];
    request.extend(fields.iter().flat_map(|field| u16::try_from(field.len()).unwrap_or_default().to_le_bytes()));
    request.extend([0, 0]);
    for field in fields {
        request.extend(field);
        request.resize(request.len().next_multiple_of(4), 0);
    }
    stream.write_all(&request)?;
    let mut head = [0; 8];
    stream.read_exact(&mut head)?;
    let [status @ 0..=2, _, _, _, _, _, low, high] = head else { return Err(ErrorKind::InvalidData.into()) };
    let mut rest = vec![0; 4 * usize::from(u16::from_le_bytes([low, high]))];
    stream.read_exact(&mut rest)?;
    if status == 1 {
        return rest.get(20).copied().map(Ok).ok_or_else(|| ErrorKind::InvalidData.into());
    }
    Ok(Err(one_line(String::from_utf8_lossy(&rest).trim_end_matches('\0').trim())))
}

/// The cookie of this user for a display at this address, or of this machine; empty if there is none.
fn cookie(peer: Option<IpAddr>, number: u16) -> Vec<u8> {
    let home = || Some(Path::new(&std::env::var_os("HOME")?).join(".Xauthority"));
    let file = std::env::var_os("XAUTHORITY").map(PathBuf::from).or_else(home);
    let all = file.and_then(|file| std::fs::read(file).ok()).unwrap_or_default();
    let (family, address) = match peer {
        Some(IpAddr::V4(address)) => (IP[0], address.octets().to_vec()),
        Some(IpAddr::V6(address)) => (IP[1], address.octets().to_vec()),
        None => (NAMED_HOST, System::host_name().unwrap_or_default().into_bytes()),
    };
    let (mut rest, number) = (all.as_slice(), number.to_string());
    while let Some((kind, after)) = rest.split_first_chunk() {
        rest = after;
        let fields: [_; 4] = std::array::from_fn(|_| field(&mut rest));
        let ([Some(host), Some(display), Some(method), Some(cookie)], kind) = (fields, u16::from_be_bytes(*kind))
        else {
            break;
        };
        let is_there = kind == EVERY_HOST || (kind == family && host == address);
        if is_there && (display.is_empty() || display == number.as_bytes()) && method == COOKIE.as_bytes() {
            return cookie.to_vec();
        }
    }
    Vec::new()
}

/// Takes a field off the beginning of an authority file's rest.
fn field<'file>(rest: &mut &'file [u8]) -> Option<&'file [u8]> {
    let (length, after) = rest.split_first_chunk()?;
    let (field, after) = after.split_at_checked(u16::from_be_bytes(*length).into())?;
    *rest = after;
    Some(field)
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
        let strange = |reason| Err(format!("what is at {display} does not answer as a display does: {reason}"));
        assert_eq!(check(&display), strange("it has closed the connection"));
        assert_eq!(check(&display), strange("it is silent for 2 s"));
        drop(silent);
    }
}
