//! The stream of a watcher: it can only request kinds of streams, which changes nothing for others. The page on which
//! somebody watches is in `web/page_routes`, the token of the stream in `slots/stream`.

use std::collections::HashSet;
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
/// receives only the watcher's requests for a kind of stream, and each kind only once, because Webots exports its whole
/// scene for each. What Webots sends is no sign that it has answered one: it sends updates to everybody.
///
/// # Errors
/// When one disconnects, or the watcher violates the protocol.
pub(super) async fn relay(
    (mut watcher, sent): (TcpStream, Bytes),
    (mut webots, answered): (TcpStream, Bytes),
) -> io::Result<()> {
    let mut frames = FrameReader::default();
    let mut to_webots = Codec::new().client_mode();
    let mut from_watcher = BytesMut::from(sent);
    let mut from_webots = BytesMut::from(answered);
    let mut requested = HashSet::new();
    loop {
        watcher.write_all(&from_webots.split()).await?;
        frames.add(&from_watcher.split());
        let mut requests = BytesMut::new();
        while let Some(frame) = frames.take().map_err(io::Error::other)? {
            match frame {
                Frame::Text(text) => {
                    if let Ok(text) = ByteString::try_from(text)
                        && let Some(kind) = requested_kind(&text)
                        && requested.insert(kind)
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

/// The kind of stream that a text requests; `None` if it is another text, or may change something for others.
fn requested_kind(text: &str) -> Option<&'static str> {
    let is_number = |text: &str| (1..5).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_digit());
    match text.strip_suffix(";broadcast")? {
        "x3d" => Some("x3d"),
        "w3d" => Some("w3d"),
        other => {
            let (width, height) = other.strip_prefix("mjpeg: ")?.split_once('x')?;
            (is_number(width) && is_number(height)).then_some("mjpeg")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_else_requests_a_kind_of_stream() {
        for (text, kind) in [
            ("x3d;broadcast", "x3d"),
            ("w3d;broadcast", "w3d"),
            ("mjpeg: 800x600;broadcast", "mjpeg"),
        ] {
            assert_eq!(requested_kind(text), Some(kind), "{text}");
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
            assert_eq!(requested_kind(text), None, "{text}");
        }
    }
}
