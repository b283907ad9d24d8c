//! The last frame of a stream whose simulation the server ends on purpose. Webots closes its WebSockets with 1001 when it is
//! told to end, which its viewer takes for a failure. The client gets 1000 and the reason instead.
//!
//! No frame before that is parsed: Webots' close frame is the last that it sends, so only the last bytes are kept back.

use actix_http::ws::{CloseCode, CloseReason, Codec, Message};
use actix_web::web::{Bytes, BytesMut};
use tokio_util::codec::Encoder;

/// Largest close frame of a server, in bytes: a header of two bytes and a content of 125 (RFC 6455, section 5.5).
const MAX_FRAME: usize = 127;
/// First byte of a close frame.
const CLOSE: u8 = 0x88;
/// Largest reason in a close frame, in bytes.
const MAX_REASON: usize = 123;

/// Keeps back what may be Webots' close frame.
pub struct LastFrame {
    kept: BytesMut,
    reason: String,
}

impl LastFrame {
    /// Nothing was kept back yet. The client gets this reason.
    pub fn new(reason: &str) -> Self {
        let (reason, _) = reason.split_at(reason.floor_char_boundary(MAX_REASON));
        Self {
            kept: BytesMut::new(),
            reason: reason.to_owned(),
        }
    }

    /// Adds what Webots has sent. Returns what no longer can belong to its last frame.
    pub fn pass(&mut self, read: &[u8]) -> Bytes {
        self.kept.extend_from_slice(read);
        let passed = self.kept.len().saturating_sub(MAX_FRAME);
        self.kept.split_to(passed).freeze()
    }

    /// What the client gets at the end. If Webots has sent no close frame, it was killed, perhaps within a frame, and its
    /// last bytes stay as they are.
    pub fn finish(mut self) -> Bytes {
        let end = (0..self.kept.len()).find(|&at| self.kept.get(at..).is_some_and(is_close_frame));
        if let Some(end) = end {
            self.kept.truncate(end);
            let close = Message::Close(Some(CloseReason {
                code: CloseCode::Normal,
                description: Some(self.reason),
            }));
            // A close frame can always be encoded.
            Codec::new().encode(close, &mut self.kept).ok();
        }
        self.kept.freeze()
    }
}

fn is_close_frame(bytes: &[u8]) -> bool {
    match bytes {
        [CLOSE, 0] => true,
        [CLOSE, length, first, second, reason @ ..] => {
            usize::from(*length) == reason.len() + 2
                && (1000..=1015).contains(&u16::from_be_bytes([*first, *second]))
                && std::str::from_utf8(reason).is_ok()
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_close_frame_is_replaced() {
        let before: Vec<u8> = (0..1000_u32).flat_map(u32::to_be_bytes).collect();
        let own = b"\x88\x06\x03\xe8time";
        let with_reason = [&b"\x88\x13\x03\xe9"[..], b"Connection closed"].concat();
        for (close, own) in [
            (&b"\x88\x02\x03\xe9"[..], &own[..]),
            (b"\x88\x00", own),
            (&with_reason, own),
            (b"", b""),
            // Half of another frame, of a Webots that was killed.
            (b"\x82\x7e\x10\x00abc", b"\x82\x7e\x10\x00abc"),
            (b"\x88\x02\x03", b"\x88\x02\x03"),
        ] {
            let sent = [&before, close].concat();
            for size in [1, 3, 100, 127, 128, sent.len()] {
                let mut last = LastFrame::new("time");
                let mut passed: Vec<u8> = sent.chunks(size).flat_map(|piece| last.pass(piece)).collect();
                passed.extend(last.finish());
                assert!(passed == [&before, own].concat(), "{close:?} by {size}");
            }
        }
        let mut last = LastFrame::new(&"ä".repeat(100));
        last.pass(b"\x88\x00");
        assert_eq!(last.finish().len(), 4 + 122, "a reason of whole letters");
    }
}
