//! The stream of a watcher: it can only request a kind of stream, which changes nothing for others.

use std::io::{self, ErrorKind};

use actix_http::ws::{Codec, Frame, Message};
use actix_rt::net::TcpStream;
use actix_web::web::{Bytes, BytesMut};
use bytestring::ByteString;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_util::codec::Encoder;

use crate::shared::http::websocket::FrameReader;

/// Size of a read, in bytes.
const BUFFER: usize = 16 * 1024;

/// Relays between a watcher and Webots until one of them disconnects; `sent` and `answered` were read already. Webots
/// receives only the watcher's requests for a kind of stream, and these only until it has answered.
///
/// # Errors
/// When one disconnects, or the watcher violates the protocol.
pub(super) async fn relay(
    (mut watcher, sent): (TcpStream, Bytes),
    (mut webots, answered): (TcpStream, Bytes),
) -> io::Result<()> {
    let (mut frames, mut to_webots) = (FrameReader::default(), Codec::new().client_mode());
    let (mut from_watcher, mut from_webots) = (BytesMut::from(sent), BytesMut::from(answered));
    let mut has_answered = false;
    loop {
        has_answered |= !from_webots.is_empty();
        watcher.write_all(&from_webots.split()).await?;
        frames.add(&from_watcher.split());
        let mut requests = BytesMut::new();
        while let Some(frame) = frames.take().map_err(io::Error::other)? {
            match frame {
                Frame::Text(text) if !has_answered => {
                    if let Ok(text) = ByteString::try_from(text)
                        && is_view_request(&text)
                    {
                        to_webots
                            .encode(Message::Text(text), &mut requests)
                            .map_err(io::Error::other)?;
                    }
                }
                Frame::Close(_) => return Ok(()),
                _ => {}
            }
        }
        webots.write_all(&requests).await?;
        from_watcher.reserve(BUFFER);
        from_webots.reserve(BUFFER);
        let read = tokio::select! {
            read = watcher.read_buf(&mut from_watcher) => read?,
            read = webots.read_buf(&mut from_webots) => read?,
        };
        if read == 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
    }
}

/// Whether a text requests a kind of stream, and changes nothing for others.
fn is_view_request(text: &str) -> bool {
    let is_number = |text: &str| (1..5).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_digit());
    let is_size = |(width, height): (&str, &str)| is_number(width) && is_number(height);
    match text.strip_suffix(";broadcast") {
        Some("x3d" | "w3d") => true,
        Some(other) => other
            .strip_prefix("mjpeg: ")
            .and_then(|size| size.split_once('x'))
            .is_some_and(is_size),
        None => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_else_is_a_view_request() {
        for text in ["x3d;broadcast", "w3d;broadcast", "mjpeg: 800x600;broadcast"] {
            assert!(is_view_request(text), "{text}");
        }
        for text in [
            "x3d",
            "pause",
            "pause;broadcast",
            "robot:a:b;broadcast",
            "mjpeg: 800x600",
            "mjpeg: 800x;broadcast",
            "mjpeg: 8x6\npause;broadcast",
            ";broadcast",
        ] {
            assert!(!is_view_request(text), "{text}");
        }
    }
}
