//! Reads the files with which a project configures its containers.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use nix::fcntl::OFlag;

/// Size limit of such a file, in bytes.
const LARGEST: u64 = 256 * 1024;

/// The text of a file; `None` if it does not exist. Anything but a regular file is refused: a symlink could resolve to
/// any path.
///
/// # Errors
/// Why it can't be read, as text for the client.
pub fn text_of(path: &Path) -> Result<Option<String>, String> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let flags = (OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK).bits();
    let file = match OpenOptions::new().read(true).custom_flags(flags).open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(format!("{name} of the project can't be read: {error}")),
    };
    let read = |file: File| -> io::Result<Option<String>> {
        let about = file.metadata()?;
        if !about.is_file() || about.len() > LARGEST {
            return Ok(None);
        }
        let mut text = String::new();
        file.take(LARGEST).read_to_string(&mut text)?;
        Ok(Some(text))
    };
    match read(file) {
        Ok(Some(text)) => Ok(Some(text)),
        Ok(None) => Err(format!("{name} of the project is no plain file of at most {} KiB", LARGEST / 1024)),
        Err(error) => Err(format!("{name} of the project can't be read: {error}")),
    }
}
