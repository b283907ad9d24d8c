//! Where log lines go: a file that is rotated, or standard output.

use std::io::Write;
use std::path::Path;

use env_logger::{Builder, Env, Target};
use file_rotate::compression::Compression;
use file_rotate::suffix::AppendCount;
use file_rotate::{ContentLimit, FileRotate};

/// How many old files are kept beside the newest, as the original does.
const OLD_FILES: usize = 10;
/// How large a file grows before it is rotated, in bytes, as the original does.
const FILE_SIZE: usize = 500_000;

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
        LogTarget::File(path) => Target::Pipe(Box::new(rotated(path, OLD_FILES)?)),
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

/// A file that is rotated by its size, with so many older ones kept beside it.
///
/// # Errors
/// When its folder can't be made, or the file can't be written.
pub fn rotated(path: &Path, old_files: usize) -> std::io::Result<FileRotate<AppendCount>> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    // FileRotate opens files lazily and keeps quiet about faults, so that the fault is looked for here.
    std::fs::OpenOptions::new().append(true).create(true).open(path)?;
    let limit = ContentLimit::BytesSurpassed(FILE_SIZE);
    Ok(FileRotate::new(path, AppendCount::new(old_files), limit, Compression::None, None))
}

/// `webots_fleet::session::registry` is read as `session::registry`.
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
