//! Where log lines go: a file that is rotated, or standard output.

use std::fmt;
use std::io::Write;
use std::path::Path;

use env_logger::{Builder, Env, Target};

use super::rotated_file::RotatedFile;
use super::timestamp::timestamp_in_milliseconds;
use crate::shared::text::one_line;

/// How many old files are kept beside the newest. The Python servers keep as many.
const OLD_FILES: usize = 10;

/// Where log lines go.
#[derive(Debug, Clone, Copy)]
pub enum LogTarget<'path> {
    /// To standard output, debug lines included.
    Stdout,
    /// To this file, which is rotated.
    File(&'path Path),
}

impl<'path> LogTarget<'path> {
    /// Standard output where `debug` is set, else this file.
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

/// Starts logging. The environment variable `RUST_LOG` can change which lines are written.
///
/// # Errors
/// When the file or its folder can't be made.
pub fn start(target: LogTarget<'_>) -> std::io::Result<()> {
    // The decoder of HTTP logs each malformed message as an error. Strangers could fill the log with them. What the resolver
    // finds out is told by who asks it.
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
