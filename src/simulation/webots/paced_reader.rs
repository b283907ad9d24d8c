//! Reads an output no faster than its limit, so that a flood uses only a small part of a core.
//!
//! A program that prints faster blocks in its own write.

use std::io::{PipeReader, Read};
use std::time::Duration;

/// The read end of a pipe, with a rate limit.
#[derive(Debug)]
pub struct PacedReader {
    output: PipeReader,
    /// In bytes per second.
    limit: u64,
    /// Bytes that were read without a pause for them.
    debt: u64,
}

/// Cost of a line besides its length, in bytes: each line is parsed, kept and written separately.
const LINE: u64 = 200;
/// Cost of a read besides its length, in bytes: a program that writes byte by byte causes a read for each.
const READ: u64 = 200;
/// Bytes without a pause: ordinary output is read at once.
const FREE: u64 = 1024;

impl PacedReader {
    /// Reads a pipe at this many bytes per second at most.
    pub fn new(output: PipeReader, limit: u64) -> Self {
        Self { output, limit: limit.max(1), debt: 0 }
    }
}

impl Read for PacedReader {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        if self.debt > FREE {
            std::thread::sleep(Duration::from_secs(1).mul_f64(per_second(self.debt, self.limit)));
            self.debt = 0;
        }
        let count = self.output.read(buffer)?;
        let read = buffer.get(..count).unwrap_or_default();
        let lines = read.split(|byte| *byte == b'\n').skip(1).count();
        self.debt += READ + u64::try_from(count).unwrap_or_default() + LINE * u64::try_from(lines).unwrap_or_default();
        Ok(count)
    }
}

#[expect(clippy::cast_precision_loss, reason = "a pause needs no more digits than f64 has")]
fn per_second(bytes: u64, limit: u64) -> f64 {
    bytes as f64 / limit as f64
}
