//! A PID file, which shows other programs whether a server runs, and in which process.

use std::fs::{File, TryLockError};
use std::io::{self, Read, Write};
use std::path::Path;

/// Writes the process id to a file, and locks the file (`flock`) until the returned file is closed. The kernel closes
/// it when the process ends for any reason.
///
/// # Errors
/// When the file can't be written, or another server holds it.
pub fn write(path: &Path) -> io::Result<File> {
    let mut file = File::options().read(true).write(true).create(true).truncate(false).open(path)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let mut pid = String::new();
            file.read_to_string(&mut pid)?;
            return Err(io::Error::other(format!("a server that runs holds it: process {}", pid.trim())));
        }
        Err(TryLockError::Error(error)) => return Err(error),
    }
    file.set_len(0)?;
    writeln!(file, "{}", std::process::id())?;
    Ok(file)
}
