//! Questions and orders to a process of the server, over the socket `control` in its directory: one line of JSON in each
//! direction. Only the server's user can open the directory.

use std::fs::File;
use std::io::{self, Write};
use std::net::TcpListener;
use std::os::unix::fs::symlink;
use std::os::unix::net::{UnixListener, UnixStream as StdUnixStream};
use std::path::{Path, PathBuf};
use std::time::Duration;

use actix_rt::time::timeout;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tokio::io::{AsyncBufRead, AsyncBufReadExt, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;

use crate::shared::run::passing::{receive, socket_in};
use crate::simulation::run_id::RunId;
use crate::simulation::snapshot::Holdings;

/// A question or an order.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum Request {
    /// What it has.
    Look,
    /// Stop these simulations.
    Stop(ForwardedStop),
    /// Stop in an orderly way, as on SIGTERM.
    End,
    /// Let a new process take over.
    Upgrade,
    /// Pass the listening socket to a process that has started because the one with the port has crashed.
    Listener,
}

/// An order to stop simulations.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ForwardedStop {
    /// Their ids.
    pub ids: Vec<String>,
    /// Why.
    pub reason: String,
    /// Who wants it, for the log.
    pub by: String,
}

/// An answer.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum Reply {
    /// What it has.
    Holdings(Holdings),
    /// It is done; the text says what.
    Done(String),
    /// It is not done, for this reason.
    Failed(String),
}

/// The name of the socket.
const CONTROL: &str = "control";
/// The link to the directory of the process that has the port.
const SERVING: &str = "serving";
/// Longest line, in bytes.
const MAX_LINE: u64 = 16 * 1024 * 1024;
/// Timeout of a passed socket.
const PASSING: Duration = Duration::from_secs(2);

/// Listens in the directory of this process.
///
/// # Errors
/// When the directory can't be written.
pub fn listen(run: &Path) -> io::Result<UnixListener> {
    UnixListener::bind(socket_in(&File::open(run)?, CONTROL))
}

/// The link in `cacheDir` to the directory of the process that has the port.
pub fn serving(cache: &Path) -> PathBuf {
    cache.join(SERVING)
}

/// Records that this process has the port.
///
/// # Errors
/// When the directory can't be written.
pub fn set_serving(cache: &Path, run: RunId) -> io::Result<()> {
    let new = cache.join(format!("{SERVING}-{run}"));
    symlink(Path::new("runs").join(run.folder()), &new)?;
    // Replaced at once, so that it is always there.
    std::fs::rename(new, serving(cache))
}

/// Asks the process with this directory.
///
/// # Errors
/// When there is none, or it does not answer in time.
pub async fn ask(run: &Path, request: &Request, limit: Duration) -> io::Result<Reply> {
    let asking = async {
        let mut socket = UnixStream::connect(socket_in(&File::open(run)?, CONTROL)).await?;
        write(&mut socket, request).await?;
        read(&mut BufReader::new(socket)).await
    };
    timeout(limit, asking).await?
}

/// Gets the listening socket of a process that has it and does not use it. Blocks for two seconds at most.
///
/// # Errors
/// When it does not answer.
pub fn listener_of(run: &Path) -> io::Result<TcpListener> {
    let mut socket = StdUnixStream::connect(socket_in(&File::open(run)?, CONTROL))?;
    socket.set_read_timeout(Some(PASSING))?;
    writeln!(socket, "{}", serde_json::to_string(&Request::Listener)?)?;
    let mut files = Vec::new();
    receive(&socket, &mut [0], &mut files)?;
    let listener = files.pop().ok_or(io::ErrorKind::InvalidData)?;
    Ok(listener.into())
}

/// Reads a line of JSON.
///
/// # Errors
/// When there is none, or another one.
pub async fn read<M: DeserializeOwned>(from: &mut (impl AsyncBufRead + Unpin)) -> io::Result<M> {
    let mut line = Vec::new();
    from.take(MAX_LINE).read_until(b'\n', &mut line).await?;
    if line.is_empty() {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    Ok(serde_json::from_slice(&line)?)
}

/// Writes a line of JSON.
///
/// # Errors
/// When the other end is gone.
pub async fn write(to: &mut (impl AsyncWrite + Unpin), message: &impl Serialize) -> io::Result<()> {
    let mut line = serde_json::to_vec(message)?;
    line.push(b'\n');
    to.write_all(&line).await
}
