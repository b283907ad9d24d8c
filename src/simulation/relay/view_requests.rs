//! The messages of a read-only client that reach Webots: requests for a kind of stream, until Webots has answered.

use std::io;

use actix_http::ws::{Codec, Frame, Message};
use actix_web::web::{Bytes, BytesMut};
use tokio_util::codec::Encoder;

use crate::shared::http::websocket::FrameReader;

/// Reads what a read-only client sends.
pub struct ViewRequests {
    from_client: FrameReader,
    to_webots: Codec,
}

impl Default for ViewRequests {
    fn default() -> Self {
        Self { from_client: FrameReader::default(), to_webots: Codec::new().client_mode() }
    }
}

impl ViewRequests {
    /// Keeps requests for a kind of stream of what the client has sent, unless Webots has answered, and drops all else.
    ///
    /// # Errors
    /// When the client closes or violates the protocol.
    pub fn filter(&mut self, sent: &[u8], has_answered: bool) -> io::Result<Bytes> {
        self.from_client.add(sent);
        let mut kept = BytesMut::new();
        while let Some(frame) = self.from_client.take().map_err(io::Error::other)? {
            match frame {
                Frame::Text(text) if !has_answered => {
                    let text = String::from_utf8_lossy(&text).into_owned();
                    if is_view_request(&text) {
                        self.to_webots.encode(Message::Text(text.into()), &mut kept).map_err(io::Error::other)?;
                    }
                }
                Frame::Close(_) => return Err(io::ErrorKind::UnexpectedEof.into()),
                _ => {}
            }
        }
        Ok(kept.freeze())
    }
}

/// Whether a text requests a kind of stream, and changes nothing for others.
fn is_view_request(text: &str) -> bool {
    let is_size = |size: &str| {
        size.split_once('x').is_some_and(|(width, height)| {
            [width, height]
                .iter()
                .all(|one| (1..5).contains(&one.len()) && one.bytes().all(|byte| byte.is_ascii_digit()))
        })
    };
    match text.strip_suffix(";broadcast") {
        Some("x3d" | "w3d") => true,
        Some(other) => other.strip_prefix("mjpeg: ").is_some_and(is_size),
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
