//! Standard output as the target of a log. It never blocks the server: lines that nobody reads are lost.

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::time::SystemTime;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use super::timestamp::timestamp_in_milliseconds;

/// Number of bytes that can be written without waiting if `poll` reports a pipe as writable (`PIPE_BUF` of Linux).
const WITHOUT_WAITING: usize = 4096;
/// Time for which a line waits for its reader, in milliseconds. While lines are lost, the next ones don't wait.
const PATIENCE: u16 = 100;

/// Standard output, usually a pipe to a service manager, which may stop reading.
#[derive(Debug)]
pub struct StandardOutput {
    output: File,
    /// Number of lines that were lost since the last one that was written.
    lost: u64,
}

impl StandardOutput {
    /// The standard output of this process.
    ///
    /// # Errors
    /// When it is closed.
    pub fn open() -> io::Result<Self> {
        let output = io::stdout().as_fd().try_clone_to_owned()?.into();
        Ok(Self { output, lost: 0 })
    }

    /// Writes a line. Returns whether it was lost, or its end.
    fn add(&mut self, line: &[u8], mut patience: PollTimeout) -> io::Result<bool> {
        for part in line.chunks(WITHOUT_WAITING) {
            let mut fds = [PollFd::new(self.output.as_fd(), PollFlags::POLLOUT)];
            if poll(&mut fds, patience)? == 0 {
                return Ok(true);
            }
            self.output.write_all(part)?;
            patience = PollTimeout::from(PATIENCE);
        }
        Ok(false)
    }
}

impl Write for StandardOutput {
    /// Writes a line, or loses it.
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let mut is_lost = false;
        if self.lost > 0 {
            let time = timestamp_in_milliseconds(SystemTime::now());
            // The last line before may lack its end.
            let notice = format!(
                "\n{time} [WARN ] log: {} lines are missing here, because nobody read standard output\n",
                self.lost
            );
            is_lost = self.add(notice.as_bytes(), PollTimeout::ZERO)?;
        }
        if !is_lost {
            self.lost = 0;
            is_lost = self.add(line, PollTimeout::from(PATIENCE))?;
        }
        self.lost += u64::from(is_lost);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
