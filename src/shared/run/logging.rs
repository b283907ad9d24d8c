//! Where log lines go: a file that is rotated, or standard output.

use std::io::Write;
use std::path::Path;

use env_logger::{Builder, Env, Target};

use super::rotated_file::RotatedFile;

/// How many old files are kept beside the newest, as the original does.
const OLD_FILES: usize = 10;

/// Where log lines go.
#[derive(Debug, Clone, Copy)]
pub enum LogTarget<'path> {
    /// To standard output, debug lines included.
    Stdout,
    /// To this file, rotated.
    File(&'path Path),
}

/// Starts logging. `RUST_LOG` overrides which lines are written.
///
/// # Errors
/// When the file's folder can't be made or written.
pub fn start(target: LogTarget<'_>) -> std::io::Result<()> {
    // The decoder logs each malformed message as an error, and who sends them decides how many there are.
    let default_level = match target {
        LogTarget::Stdout => {
            "debug,actix_http=info,actix_http::h1::decoder=off,actix_server=info,mio=info,rustls=info,h2=info"
        }
        LogTarget::File(_) => "info,actix_http::h1::decoder=off,actix_server=warn",
    };
    let mut builder = Builder::from_env(Env::default().default_filter_or(default_level));
    builder.target(match target {
        LogTarget::Stdout => Target::Stdout,
        LogTarget::File(path) => Target::Pipe(Box::new(RotatedFile::open(path, OLD_FILES)?)),
    });
    builder.format(|out, record| {
        let time = timestamp(std::time::SystemTime::now());
        writeln!(
            out,
            "{time} [{:<5}] {}: {}",
            record.level(),
            room(record.target()),
            one_line(&record.args().to_string())
        )
    });
    builder.try_init().map_err(std::io::Error::other)
}

/// `crate::session::fleet::registry` is read as `session::registry`.
fn room(target: &str) -> &str {
    target.strip_prefix("webots_fleet::").unwrap_or(target)
}

/// A text in which nothing can start a new line or steer a terminal: what comes from outside can't forge log lines.
#[must_use]
pub fn one_line(text: &str) -> String {
    text.chars().map(|letter| if letter.is_control() { ' ' } else { letter }).collect()
}

fn timestamp(now: std::time::SystemTime) -> impl std::fmt::Display {
    jiff::Timestamp::try_from(now).map_or_else(|_| String::from("-"), |time| format!("{time:.3}"))
}
