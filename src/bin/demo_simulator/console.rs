//! What the program prints. The status lines are Webots' and always on the standard output, each flushed
//! at once, because whoever started the program reads them from a pipe; remarks need `--stdout`, warnings
//! and errors `--stderr`.

use std::fmt::Display;
use std::io;

/// Where remarks, warnings and errors go.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Console {
    /// Whether remarks are printed.
    pub(crate) stdout: bool,
    /// Whether warnings and errors are printed.
    pub(crate) stderr: bool,
}

impl Console {
    /// Prints a remark, with `--stdout`.
    pub(crate) fn info(self, text: impl Display) {
        if self.stdout {
            print(io::stdout(), &format!("INFO: {text}"));
        }
    }

    /// Prints a warning, with `--stderr`.
    pub(crate) fn warning(self, text: impl Display) {
        if self.stderr {
            print(io::stderr(), &format!("WARNING: {text}"));
        }
    }

    /// Prints an error, with `--stderr`.
    pub(crate) fn error(self, text: impl Display) {
        if self.stderr {
            print(io::stderr(), &format!("ERROR: {text}"));
        }
    }
}

/// Prints what ends the program, whatever the options.
pub(crate) fn fatal(text: impl Display) {
    print(io::stderr(), &format!("webots: {text}"));
}

/// Prints a line on the standard output, such as `.` or `pause`.
pub(crate) fn status(line: &str) {
    print(io::stdout(), line);
}

/// Prints plain text on the standard error.
pub(crate) fn explain(text: &str) {
    print(io::stderr(), text);
}

fn print(mut stream: impl io::Write, line: &str) {
    // a reader that went away is no reason to end: the signal to end comes separately
    drop(writeln!(stream, "{line}").and_then(|()| stream.flush()));
}
