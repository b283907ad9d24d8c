//! Connections of clients that another process of the server goes on with, after an upgrade: whoever serves what a
//! request is for gets the connection itself (its descriptor), with what was read from it, and serves it until a request
//! on it is for somebody else. Nothing is copied, and each process sees the client's own address.
//! A client that sends a request before it has all of the answer to the one before, which browsers and proxies do not, may
//! lose the rest of that answer.
//!
//! Each process takes such connections at its *door*, a Unix socket in a directory that only the server's user can open.

use std::fs::File;
use std::io;
use std::os::fd::AsFd;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};

use actix_web::rt::net::{TcpStream, UnixStream};
use actix_web::web::BytesMut;
use tokio::io::{AsyncReadExt, AsyncWriteExt, Interest};

use crate::shared::run::passing::{receive, send, socket_in};

/// Tells whose a connection is.
pub trait Router: Send + Sync {
    /// Whose a request for this path is.
    fn request(&self, path: &str) -> Owner;

    /// The directory of another process, if this first message on a WebSocket is for that.
    fn message(&self, text: &str) -> Option<PathBuf>;
}

/// Whose a request is.
#[derive(Debug, PartialEq, Eq)]
pub enum Owner {
    /// It is for this process.
    This,
    /// The first message on its WebSocket tells.
    OfFirstMessage,
    /// It is for the process with this directory.
    Other(PathBuf),
}

/// The name of the socket in the directory of a process.
const DOOR: &str = "door";
/// Size limit of what was read from a connection: a head, a body and a message.
const MAX_READ: u64 = 256 * 1024;

/// What was done with a connection.
pub(super) struct ServedSoFar {
    /// What was read from it and not yet served, from the head of a request on.
    pub(super) unread: BytesMut,
    /// Whether the client has the answer to that request already: its WebSocket is open.
    pub(super) is_answered: bool,
}

/// Listens at the door of this process.
///
/// # Errors
/// When the directory can't be written.
pub fn open_door(folder: &Path) -> io::Result<UnixListener> {
    UnixListener::bind(socket_in(&File::open(folder)?, DOOR))
}

/// Passes a connection to the process with this directory.
pub(super) async fn pass(folder: &Path, tcp: &TcpStream, progress: &ServedSoFar) -> io::Result<()> {
    let mut door = UnixStream::connect(socket_in(&File::open(folder)?, DOOR)).await?;
    let kind = [u8::from(progress.is_answered)];
    door.async_io(Interest::WRITABLE, || send(&door, &kind, &[tcp.as_fd()]))
        .await?;
    door.write_all(&progress.unread).await?;
    door.shutdown().await
}

/// Receives a connection at the door.
pub(super) async fn take(door: UnixStream) -> io::Result<(TcpStream, ServedSoFar)> {
    let mut kind = [0];
    let mut files = Vec::new();
    door.async_io(Interest::READABLE, || receive(&door, &mut kind, &mut files))
        .await?;
    let mut unread = Vec::new();
    door.take(MAX_READ).read_to_end(&mut unread).await?;
    let tcp = std::net::TcpStream::from(files.pop().ok_or(io::ErrorKind::InvalidData)?);
    tcp.set_nonblocking(true)?;
    let progress = ServedSoFar {
        unread: BytesMut::from(unread.as_slice()),
        is_answered: kind == [1],
    };
    Ok((TcpStream::from_std(tcp)?, progress))
}
