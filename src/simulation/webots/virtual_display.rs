//! A virtual display (Xvfb) for one Webots that has no sandbox.
//!
//! Xvfb chooses a free display number by itself and prints it (`-displayfd`). In this mode it writes no lock file, and
//! reuses the socket that a killed one has left in `/tmp/.X11-unix`: nothing has to be removed after it.

use std::ffi::OsString;
use std::fs::File;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use actix_rt::task::JoinHandle;
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::net::unix::pipe::Receiver;

use crate::simulation::isolation::SCREEN;
use crate::simulation::process::{ExitReason, ProcessGroup, SpawnSpec};

/// A running Xvfb. Dropping it kills it.
#[derive(Debug)]
pub struct VirtualDisplay {
    name: String,
    authority: PathBuf,
    group: ProcessGroup,
    ended: JoinHandle<ExitReason>,
}

/// Timeout of Xvfb's start.
const START: Duration = Duration::from_secs(10);
/// Time between SIGTERM and SIGKILL when Xvfb is ended.
const GRACE: Duration = Duration::from_secs(1);
/// In an authority file: the entry counts for every host. `FamilyWild` of X11/Xauth.h.
const EVERY_HOST: u16 = 0xffff;
/// The only authorization method that all clients support.
const COOKIE: &[u8] = b"MIT-MAGIC-COOKIE-1";

impl VirtualDisplay {
    /// Starts Xvfb. Its files are in the instance's directory, whose mark it has.
    ///
    /// # Errors
    /// When Xvfb can't be started, exits, or prints no display within ten seconds.
    pub async fn start(instance: &Path) -> std::io::Result<Self> {
        let (authority, log) = (write_authority(instance)?, instance.join("xvfb.log"));
        let (reader, output) = std::io::pipe()?;
        let mut command: Vec<OsString> =
            ["Xvfb", "-displayfd", "1", "-screen", "0", SCREEN, "-nolisten", "tcp", "-auth"].map(OsString::from).into();
        command.push(authority.clone().into());
        let spec = SpawnSpec { grace: GRACE, ..SpawnSpec::new(command, instance) };
        let (group, ended) = ProcessGroup::start(&spec, output.into(), File::create(&log)?.into())?;
        let ended = actix_rt::spawn(ended);
        let mut line = String::new();
        let mut reader = BufReader::new(Receiver::from_owned_fd(reader.into())?);
        let read = actix_rt::time::timeout(START, reader.read_line(&mut line)).await;
        match line.trim().parse::<u16>() {
            Ok(number) => Ok(Self { name: format!(":{number}"), authority, group, ended }),
            Err(_) if read.is_err() => Err(std::io::ErrorKind::TimedOut.into()),
            Err(_) => {
                let text = std::fs::read_to_string(log).unwrap_or_default();
                Err(std::io::Error::other(text.trim().lines().last().unwrap_or("it has ended").to_owned()))
            }
        }
    }

    /// The environment variables that name the display.
    pub fn environment(&self) -> Vec<(OsString, OsString)> {
        vec![("DISPLAY".into(), self.name.clone().into()), ("XAUTHORITY".into(), self.authority.clone().into())]
    }

    /// Stops Xvfb. Returns when it has exited.
    pub async fn stop(mut self) {
        self.group.terminate();
        self.ended.await.ok();
    }
}

/// Writes an authority file with one random cookie into the instance's folder, and returns its path.
pub fn write_authority(instance: &Path) -> std::io::Result<PathBuf> {
    let path = instance.join("Xauthority");
    let cookie: [u8; 16] = rand::random();
    let mut entry = EVERY_HOST.to_be_bytes().to_vec();
    // No address and no display number: the entry applies to all.
    for field in [&[], &[], COOKIE, &cookie] {
        entry.extend(u16::try_from(field.len()).unwrap_or_default().to_be_bytes());
        entry.extend(field);
    }
    File::options().create(true).truncate(true).write(true).mode(0o600).open(&path)?.write_all(&entry)?;
    Ok(path)
}
