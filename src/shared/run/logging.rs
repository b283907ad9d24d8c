//! The log: to a file that is rotated, or to standard output, which loses lines that nobody reads.

use std::io::Write;
use std::path::Path;

use env_logger::{Builder, Env, Target};

use super::rotated_file::RotatedFile;
use super::standard_output::StandardOutput;
use super::timestamp::timestamp_in_milliseconds;
use crate::shared::text::one_line;

/// Size from which the log is rotated, in bytes.
const MAX_SIZE: u64 = 2_500_000;

/// Starts logging to a rotated file, or without one to standard output with debug lines. `RUST_LOG` overrides levels.
///
/// # Errors
/// When the file or its directory can't be created, or standard output is closed.
pub fn start(file: Option<&Path>) -> std::io::Result<()> {
    // The HTTP decoder logs each malformed message as an error. Any client could flood the log with these. Resolver
    // errors are logged by the caller.
    let level = match file {
        None => "debug,actix_http=info,actix_server=info,mio=info,rustls=info,h2=info,tungstenite=info",
        Some(_) => "info,actix_server=warn",
    };
    let level = format!("{level},actix_http::h1::decoder=off,hickory_net=off,hickory_proto=off,hickory_resolver=off");
    let mut builder = Builder::from_env(Env::default().default_filter_or(level));
    builder.target(match file {
        None => Target::Pipe(Box::new(StandardOutput::open()?)),
        Some(path) => Target::Pipe(Box::new(RotatedFile::open(path, MAX_SIZE, "")?)),
    });
    builder.format(|out, record| {
        let time = timestamp_in_milliseconds(std::time::SystemTime::now());
        writeln!(
            out,
            "{time} [{:<5}] {}: {}",
            record.level(),
            record.target().trim_start_matches("webots_fleet::"),
            one_line(&record.args().to_string())
        )
    });
    let logger = builder.build();
    log::set_max_level(logger.filter());
    log::set_boxed_logger(Box::new(logger)).map_err(std::io::Error::other)
}
