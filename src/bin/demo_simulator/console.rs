//! What the program prints. Each line is flushed at once, because whoever started the program reads it
//! from a pipe.

use std::fmt::Display;
use std::io;

/// Prints information and errors as far as the command line asks for them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Console {
    /// Whether information is printed on the standard output.
    pub(crate) stdout: bool,
    /// Whether warnings and errors are printed on the standard error.
    pub(crate) stderr: bool,
}

impl Console {
    /// Prints information, with `--stdout`.
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

/// Prints why the program ends with a failure; does not depend on the command line.
pub(crate) fn fatal(text: impl Display) {
    print(io::stderr(), &format!("webots: {text}"));
}

/// Prints a text on the standard error as it is.
pub(crate) fn explain(text: &str) {
    print(io::stderr(), text);
}

/// Prints a line that simulation servers read, such as `.` or `pause`; does not depend on the command line.
pub(crate) fn status(line: &str) {
    print(io::stdout(), line);
}

fn print(mut stream: impl io::Write, line: &str) {
    // a reader that went away is no reason to end: the signal to end comes separately
    drop(writeln!(stream, "{line}").and_then(|()| stream.flush()));
}
