//! The messages of a read-only client that reach Webots: requests for a kind of stream, until Webots has answered.

use std::cell::Cell;

use actix_http::ws::{Codec, Frame, Message};
use actix_web::web::BytesMut;
use futures_util::StreamExt;
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt};
use tokio_util::codec::{Encoder, FramedRead};

/// Size limit of a message, in bytes.
const MAX_MESSAGE: usize = 8 * 1024;

/// Forwards requests for a kind of stream, and drops all else. Returns when the client closes or violates the protocol.
pub async fn forward(
    from_client: impl AsyncRead + Unpin,
    to_webots: &mut (impl AsyncWrite + Unpin),
    has_answered: &Cell<bool>,
) {
    let mut frames = FramedRead::new(from_client, Codec::new().max_size(MAX_MESSAGE));
    let mut codec = Codec::new().client_mode();
    while let Some(Ok(frame)) = frames.next().await {
        let text = match frame {
            Frame::Text(text) if !has_answered.get() => String::from_utf8_lossy(&text).into_owned(),
            Frame::Close(_) => return,
            _ => continue,
        };
        let mut bytes = BytesMut::new();
        let is_encoded = is_view_request(&text) && codec.encode(Message::Text(text.into()), &mut bytes).is_ok();
        if is_encoded && to_webots.write_all(&bytes).await.is_err() {
            return;
        }
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
