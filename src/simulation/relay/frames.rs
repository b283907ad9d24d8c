//! The frames that Webots sends over a stream. Only their heads are read, to know where each ends.
//!
//! If the server ends the simulation on purpose, its client gets the code 1000 and the reason after the last whole frame:
//! Webots closes with 1001 when it is told to end, which its viewer takes for a failure, and one that is killed, as in
//! containers, closes with nothing.

use std::borrow::Cow;

use actix_http::ws::{CloseCode, CloseReason, Codec, Message};
use actix_web::web::BytesMut;
use tokio_util::codec::Encoder;

/// The opcode of a close frame (RFC 6455, section 5.2), which is the low half of a frame's first byte.
const CLOSE: u8 = 8;
/// Largest reason in a close frame, in bytes.
const MAX_REASON: usize = 123;

/// How far a stream is within a frame.
#[derive(Debug, Default)]
pub struct Frames {
    /// The beginning of a head that has not come as a whole.
    head: Vec<u8>,
    /// Bytes that are missing of the frame after its head.
    left: u64,
    /// Whose close frame the client gets, once there is one.
    closed_by: Option<End>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    Webots,
    Server,
}

impl Frames {
    /// Follows what Webots has sent; returns what the client gets of it. `ending` is the reason why the server ends the
    /// simulation: a close frame is then replaced.
    pub fn pass<'read>(&mut self, read: &'read [u8], ending: Option<&str>) -> Cow<'read, [u8]> {
        match self.closed_by {
            Some(End::Webots) => return read.into(),
            Some(End::Server) => return Cow::default(),
            None => {}
        }
        let mut rest = read;
        while let Some(first) = rest.first() {
            if self.is_between() && first & 0x0f == CLOSE {
                let Some(reason) = ending else {
                    self.closed_by = Some(End::Webots);
                    return read.into();
                };
                self.closed_by = Some(End::Server);
                let before = read.get(..read.len() - rest.len()).unwrap_or_default();
                return [before, &close(reason)].concat().into();
            }
            rest = self.skip(rest);
        }
        read.into()
    }

    /// The close frame for a client whose Webots has closed the connection without one; `None` if there was one, or if
    /// the last frame is not whole.
    pub fn close(&mut self, reason: &str) -> Option<Vec<u8>> {
        if self.closed_by.is_some() || !self.is_between() {
            return None;
        }
        self.closed_by = Some(End::Server);
        Some(close(reason))
    }

    /// Whether the next byte begins a frame.
    fn is_between(&self) -> bool {
        self.left == 0 && self.head.is_empty()
    }

    /// Follows these bytes, which are not empty, to the end of a head or of a frame; returns the rest.
    fn skip<'read>(&mut self, bytes: &'read [u8]) -> &'read [u8] {
        if self.left > 0 {
            let length = usize::try_from(self.left).unwrap_or(usize::MAX).min(bytes.len());
            self.left -= length as u64;
            return bytes.get(length..).unwrap_or_default();
        }
        let (next, rest) = bytes.split_at(1);
        self.head.extend_from_slice(next);
        if let Some(length) = content(&self.head) {
            self.head.clear();
            self.left = length;
        }
        rest
    }
}

/// The length of a frame's content, once its head is whole.
fn content(head: &[u8]) -> Option<u64> {
    let second = head.get(1)?;
    let extended = match second & 0x7f {
        126 => 2,
        127 => 8,
        _ => 0,
    };
    let mask = if second & 0x80 == 0 { 0 } else { 4 };
    if head.len() < 2 + extended + mask {
        return None;
    }
    let number = head.get(2..2 + extended)?;
    Some(if extended == 0 {
        u64::from(second & 0x7f)
    } else {
        number.iter().fold(0, |sum, byte| sum << 8 | u64::from(*byte))
    })
}

fn close(reason: &str) -> Vec<u8> {
    let (reason, _) = reason.split_at(reason.floor_char_boundary(MAX_REASON));
    let mut frame = BytesMut::new();
    let close = Message::Close(Some(CloseReason {
        code: CloseCode::Normal,
        description: Some(reason.to_owned()),
    }));
    // A close frame can always be encoded.
    Codec::new().encode(close, &mut frame).ok();
    frame.to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;

    const OWN: &[u8] = b"\x88\x06\x03\xe8time";

    /// What the client gets of these bytes, in pieces of this size, and of the end of the connection.
    fn passed(sent: &[u8], size: usize, ending: Option<&str>) -> Vec<u8> {
        let mut frames = Frames::default();
        let mut passed = Vec::new();
        for piece in sent.chunks(size) {
            passed.extend_from_slice(&frames.pass(piece, ending));
        }
        passed.extend(ending.and_then(|reason| frames.close(reason)).unwrap_or_default());
        passed
    }

    /// A frame with a content of this length, which has bytes of any frame.
    fn frame(length: usize) -> Vec<u8> {
        let number = (length as u64).to_be_bytes();
        let mut frame = match length {
            0..126 => vec![0x81, number[7]],
            126..65536 => [&[0x82, 126], &number[6..]].concat(),
            _ => [&[0x02, 127], &number[..]].concat(),
        };
        frame.extend(b"\x88\x02\x03\xe9".iter().cycle().take(length));
        frame
    }

    #[test]
    fn only_the_last_frame_is_replaced_or_added() {
        let before: Vec<u8> = [0, 1, 125, 126, 127, 4000, 65535, 65536]
            .into_iter()
            .flat_map(frame)
            .collect();
        let with_reason = [&b"\x88\x13\x03\xe9"[..], b"Connection closed"].concat();
        let half = &frame(4000)[..1000];
        for (last, own) in [
            (&b"\x88\x02\x03\xe9"[..], OWN),
            (b"\x88\x00", OWN),
            (b"\x88\x02\x03", OWN),
            (&with_reason, OWN),
            // Webots was killed.
            (b"", OWN),
            (b"\x82", b"\x82"),
            (b"\x82\x7e\x10", b"\x82\x7e\x10"),
            (half, half),
        ] {
            let sent = [&before, last].concat();
            for size in [1, 3, 100, 127, 128, sent.len()] {
                let own = [&before, own].concat();
                assert!(passed(&sent, size, Some("time")) == own, "{last:?} by {size}");
                assert!(passed(&sent, size, None) == sent, "{last:?} by {size}");
            }
        }
    }

    #[test]
    fn a_client_gets_no_second_close_frame() {
        let mut frames = Frames::default();
        assert_eq!(frames.pass(b"\x88\x02\x03", None), &b"\x88\x02\x03"[..]);
        assert_eq!(frames.close("time"), None);
        let mut frames = Frames::default();
        assert_eq!(frames.close("time").as_deref(), Some(OWN));
        assert_eq!(frames.close("time"), None);
    }

    #[test]
    fn a_long_reason_ends_with_a_whole_letter() {
        assert_eq!(close(&"\u{e4}".repeat(100)).len(), 4 + 122);
    }

    #[test]
    fn masks_belong_to_heads() {
        assert_eq!(
            passed(b"\x81\x82maskhi", 1, Some("time")),
            [b"\x81\x82maskhi", OWN].concat()
        );
    }
}
