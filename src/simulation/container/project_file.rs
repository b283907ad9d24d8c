//! Reads the files with which a project configures its containers.

use std::io;
use std::path::Path;

/// Size limit of such a file, in bytes.
const MAX_SIZE: u64 = 256 * 1024;

/// The text of a file of a project in which nothing runs yet; `None` if it does not exist. Anything but a regular file is
/// refused: a symlink could resolve to any path.
///
/// # Errors
/// Why it can't be read, as text for the client.
pub fn text_of(path: &Path) -> Result<Option<String>, String> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Ok(about) if about.is_file() && about.len() <= MAX_SIZE => {
            let text = std::fs::read_to_string(path);
            text.map(Some).map_err(|error| format!("{name} of the project can't be read: {error}"))
        }
        _ => Err(format!("{name} of the project is no plain file of at most {} KiB", MAX_SIZE / 1024)),
    }
}
