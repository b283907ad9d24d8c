//! The output of the program. Each line is flushed at once, because the parent process reads it from a pipe.

use std::fmt::Display;
use std::io;

/// Prints information and errors if the command line requests them.
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

    /// Prints a line, which begins with `WARNING: ` or `ERROR: `, with `--stderr`.
    pub(crate) fn trouble(self, line: &str) {
        if self.stderr {
            print(io::stderr(), line);
        }
    }
}

/// Prints why the program fails, regardless of the command line.
pub(crate) fn fatal(text: impl Display) {
    print(io::stderr(), &format!("webots: {text}"));
}

/// Prints a text verbatim on the standard error.
pub(crate) fn explain(text: &str) {
    print(io::stderr(), text);
}

/// Prints a line that simulation servers parse, such as `.` or `pause`, regardless of the command line.
pub(crate) fn status(line: &str) {
    print(io::stdout(), line);
}

fn print(mut stream: impl io::Write, line: &str) {
    // a closed pipe does not end the program: the signal to end comes separately
    drop(writeln!(stream, "{line}").and_then(|()| stream.flush()));
}
