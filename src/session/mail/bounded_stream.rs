//! A connection that fails once its peer has sent too much.
//!
//! lettre reads a line of an SMTP server into memory until it ends, however long it is.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use lettre::transport::smtp::client::AsyncTokioStream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// How many bytes an SMTP server may send for one e-mail, those of TLS included.
const MAX_RECEIVED: usize = 1024 * 1024;

/// A connection whose peer may send at most [`MAX_RECEIVED`] bytes.
#[derive(Debug)]
pub struct BoundedStream<S> {
    inner: S,
    peer: SocketAddr,
    received: usize,
}

impl<S> BoundedStream<S> {
    /// Bounds a connection to `peer`.
    pub fn new(inner: S, peer: SocketAddr) -> Self {
        Self { inner, peer, received: 0 }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for BoundedStream<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        ready!(Pin::new(&mut self.inner).poll_read(context, buffer))?;
        self.received += buffer.filled().len() - before;
        if self.received > MAX_RECEIVED {
            return Poll::Ready(Err(io::Error::other(format!("it sends more than {} KiB", MAX_RECEIVED / 1024))));
        }
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for BoundedStream<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.inner).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_shutdown(context)
    }
}

impl<S: AsyncRead + AsyncWrite + Send + Sync + Unpin + std::fmt::Debug> AsyncTokioStream for BoundedStream<S> {
    fn peer_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.peer)
    }
}
