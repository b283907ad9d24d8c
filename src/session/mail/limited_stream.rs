//! A connection to an SMTP server that may send only so much: lettre reads a line of any length into memory.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use lettre::transport::smtp::client::AsyncTokioStream;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// The most that an SMTP server may send, in bytes. The answers to one e-mail have a few kilobytes, with certificates.
const LIMIT: usize = 64 << 10;

/// A stream from which [`LIMIT`] bytes can be read; then reading fails.
#[derive(Debug)]
pub(super) struct LimitedStream<Stream> {
    stream: Stream,
    peer: SocketAddr,
    received: usize,
}

impl<Stream> LimitedStream<Stream> {
    /// Limits a stream, whose other end is `peer`.
    pub(super) fn new(stream: Stream, peer: SocketAddr) -> Self {
        Self {
            stream,
            peer,
            received: 0,
        }
    }
}

impl<Stream: AsyncRead + Unpin> AsyncRead for LimitedStream<Stream> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(cx, buffer))?;
        self.received += buffer.filled().len() - before;
        Poll::Ready(if self.received <= LIMIT {
            Ok(())
        } else {
            Err(io::Error::other(format!("it has sent more than {LIMIT} bytes")))
        })
    }
}

impl<Stream: AsyncWrite + Unpin> AsyncWrite for LimitedStream<Stream> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

impl<Stream: AsyncRead + AsyncWrite + Send + Sync + Unpin + std::fmt::Debug> AsyncTokioStream
    for LimitedStream<Stream>
{
    fn peer_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.peer)
    }
}
