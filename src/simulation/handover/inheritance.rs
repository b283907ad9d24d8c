//! What a new process gets from the one before, over the Unix socket that is its standard input.

use std::fs::File;
use std::io::{self, Read, Write};
use std::net::TcpListener;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;

use serde::{Deserialize, Serialize};
use tokio::io::BufReader;

use super::control::{read, write};
use crate::shared::run::passing::receive;
use crate::simulation::run_id::RunId;
use crate::simulation::snapshot::Holdings;

/// The option of a program that takes over from another process.
pub const TAKES_OVER: &str = "--takes-over";
/// Version of the messages, and of how processes share `cacheDir`. A process takes nothing over from another version:
/// the old one then goes on, and is drained.
pub const PROTOCOL: u32 = 1;

/// The first message to the new process. With it come the listening socket, the lock of `cacheDir`, and that of the PID
/// file if there is one.
#[derive(Debug, Serialize, Deserialize)]
pub struct Takeover {
    /// Version of the messages.
    pub protocol: u32,
    /// The old process.
    pub run: RunId,
    /// The secret that signs administrators' sign-ins in a fleet without a key.
    pub sign_in: String,
}

/// What the first message of each version has.
#[derive(Deserialize)]
struct Version {
    protocol: u32,
}

/// What the new process answers.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum ToPredecessor {
    /// It is ready to serve.
    Ready {
        /// The new process.
        run: RunId,
        /// Its process id.
        pid: u32,
    },
    /// It can't start, for this reason.
    Failed(String),
}

/// The last message to the new process: it has the port now, and the old one has this left.
#[derive(Debug, Serialize, Deserialize)]
pub struct ToSuccessor(pub Holdings);

/// What a process gets from the one before.
pub struct Inheritance {
    /// The listening socket.
    pub listener: TcpListener,
    /// Locks `cacheDir`.
    pub lock: Option<File>,
    /// Locked while the server runs.
    pub pid_file: Option<File>,
    /// The secret that signs administrators' sign-ins.
    pub sign_in: String,
    /// The process before.
    pub run: RunId,
    channel: UnixStream,
}

impl Inheritance {
    /// Receives it. Blocks.
    ///
    /// # Errors
    /// When the process before has another version, or is gone; as text for an administrator.
    pub fn receive() -> Result<Self, String> {
        let stdin = io::stdin().as_fd().try_clone_to_owned();
        stdin
            .and_then(|stdin| Self::receive_from(stdin.into()))
            .map_err(|error| format!("nothing can be taken over from the process before: {error}"))
    }

    fn receive_from(channel: UnixStream) -> io::Result<Self> {
        let mut files = Vec::new();
        let mut line = vec![0];
        receive(&channel, &mut line, &mut files)?;
        // The rest of the line; what follows is not read.
        let mut byte = [0];
        while !line.ends_with(b"\n") {
            (&channel).read_exact(&mut byte)?;
            line.extend(byte);
        }
        let Version { protocol } = serde_json::from_slice(&line)?;
        if protocol != PROTOCOL {
            let why = format!("its version is {protocol}, and this one's {PROTOCOL}");
            fail(&channel, &why);
            return Err(io::Error::other(why));
        }
        let passed: Takeover = serde_json::from_slice(&line)?;
        let mut files = files.into_iter();
        let lacks = || io::Error::other("files are missing");
        Ok(Self {
            listener: files.next().ok_or_else(lacks)?.into(),
            lock: Some(files.next().ok_or_else(lacks)?.into()),
            pid_file: files.next().map(File::from),
            sign_in: passed.sign_in,
            run: passed.run,
            channel,
        })
    }

    /// Tells the process before why this one can't start.
    pub fn fail(&self, why: &str) {
        fail(&self.channel, why);
    }

    /// Tells the process before that this one is ready, and waits until it has the port. Returns what is left to the one
    /// before.
    ///
    /// # Errors
    /// When that has ended.
    pub async fn take_over(&self) -> io::Result<Holdings> {
        let channel = self.channel.try_clone()?;
        channel.set_nonblocking(true)?;
        let mut channel = BufReader::new(tokio::net::UnixStream::from_std(channel)?);
        let ready = ToPredecessor::Ready {
            run: RunId::own(),
            pid: std::process::id(),
        };
        write(&mut channel, &ready).await?;
        let ToSuccessor(left) = read(&mut channel).await?;
        Ok(left)
    }
}

/// Tells the process before why the new one can't start.
fn fail(mut channel: &UnixStream, why: &str) {
    if let Ok(line) = serde_json::to_string(&ToPredecessor::Failed(why.to_owned())) {
        // It may have ended.
        writeln!(channel, "{line}").ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::run::passing::send;

    #[test]
    fn nothing_is_taken_over_from_another_version() {
        for (protocol, is_taken) in [(PROTOCOL, true), (PROTOCOL + 1, false), (PROTOCOL - 1, false)] {
            let (mut before, channel) = UnixStream::pair().unwrap();
            let passed = Takeover {
                protocol,
                run: RunId::own(),
                sign_in: String::new(),
            };
            let line = serde_json::to_string(&passed).unwrap() + "\n";
            let files: [std::os::fd::OwnedFd; 2] = [
                TcpListener::bind("127.0.0.1:0").unwrap().into(),
                tempfile::tempfile().unwrap().into(),
            ];
            send(&before, line.as_bytes(), &files.each_ref().map(AsFd::as_fd)).unwrap();
            let taken = Inheritance::receive_from(channel);
            assert_eq!(taken.is_ok(), is_taken, "{protocol}");
            drop(taken);
            let mut told = String::new();
            before.read_to_string(&mut told).unwrap();
            let why = format!("{{\"failed\":\"its version is {protocol}, and this one's {PROTOCOL}\"}}\n");
            assert_eq!(told, if is_taken { String::new() } else { why });
        }
    }
}
