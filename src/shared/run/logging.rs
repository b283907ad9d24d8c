//! The log: to a file that is rotated, or to standard output.

use std::fmt;
use std::io::Write;
use std::path::Path;

use env_logger::{Builder, Env, Target};

use super::rotated_file::RotatedFile;
use super::timestamp::timestamp_in_milliseconds;
use crate::shared::text::one_line;

/// Number of rotated files that are kept, as in the Python servers.
const OLD_FILES: usize = 10;

/// The destination of log lines.
#[derive(Debug, Clone, Copy)]
pub enum LogTarget<'path> {
    /// To standard output, debug lines included.
    Stdout,
    /// To this file, which is rotated.
    File(&'path Path),
}

impl<'path> LogTarget<'path> {
    /// Standard output if `debug` is set, else this file.
    pub fn new(debug: bool, file: &'path Path) -> Self {
        if debug { Self::Stdout } else { Self::File(file) }
    }
}

impl fmt::Display for LogTarget<'_> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stdout => out.write_str("standard output"),
            Self::File(path) => path.display().fmt(out),
        }
    }
}

/// Starts logging. The environment variable `RUST_LOG` overrides which lines are written.
///
/// # Errors
/// When the file or its directory can't be created.
pub fn start(target: LogTarget<'_>) -> std::io::Result<()> {
    // The HTTP decoder logs each malformed message as an error. Any client could flood the log with these. Resolver
    // errors are logged by the caller.
    let default_level = match target {
        LogTarget::Stdout => {
            "debug,actix_http=info,actix_http::h1::decoder=off,actix_server=info,mio=info,rustls=info,h2=info,\
             hickory_net=off,hickory_proto=off,hickory_resolver=off"
        }
        LogTarget::File(_) => {
            "info,actix_http::h1::decoder=off,actix_server=warn,hickory_net=off,hickory_proto=off,hickory_resolver=off"
        }
    };
    let mut builder = Builder::from_env(Env::default().default_filter_or(default_level));
    builder.target(match target {
        LogTarget::Stdout => Target::Stdout,
        LogTarget::File(path) => Target::Pipe(Box::new(RotatedFile::open(path, OLD_FILES)?)),
    });
    builder.format(|out, record| {
        let time = timestamp_in_milliseconds(std::time::SystemTime::now());
        writeln!(
            out,
            "{time} [{:<5}] {}: {}",
            record.level(),
            short(record.target()),
            one_line(&record.args().to_string())
        )
    });
    let logger = builder.build();
    log::set_max_level(logger.filter());
    log::set_boxed_logger(Box::new(logger)).map_err(std::io::Error::other)
}

/// A module's path without the name of the crate.
fn short(target: &str) -> &str {
    target.strip_prefix("webots_fleet::").unwrap_or(target)
}
