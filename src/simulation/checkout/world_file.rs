//! The world of a checkout: it must be a file inside of it, and name its version of Webots.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

/// Why a file is not a valid world. The messages are for the client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WorldFileError {
    /// There is no such file.
    #[error("{0} does not exist")]
    Missing(String),
    /// It is a symlink to a file outside of the checkout.
    #[error("{0} leads out of its repository")]
    Outside(String),
    /// Its first line is not that of a world.
    #[error("{name} is no world file: its first line is {found:?}, not like \"#VRML_SIM R2025a utf8\"")]
    Header {
        /// The file name.
        name: String,
        /// Its first line.
        found: String,
    },
}

/// A valid world.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorldFile {
    /// The canonical path of the file, without symlinks.
    pub path: PathBuf,
    /// The version of Webots that it was made for, such as `R2025a`.
    pub version: String,
}

impl WorldFile {
    /// Inspects a world file below the directory `root`. Blocks.
    ///
    /// # Errors
    /// When it is not a world inside of that directory.
    pub fn open(root: &Path, path: &Path) -> Result<Self, WorldFileError> {
        let name = || path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let missing = |_| WorldFileError::Missing(name());
        let root = root.canonicalize().map_err(missing)?;
        let path = path.canonicalize().map_err(missing)?;
        if !path.starts_with(&root) {
            return Err(WorldFileError::Outside(name()));
        }
        if !path.is_file() {
            return Err(WorldFileError::Missing(name()));
        }
        let file = std::fs::File::open(&path).map_err(missing)?;
        let mut line = Vec::new();
        BufReader::new(file.take(200)).read_until(b'\n', &mut line).map_err(missing)?;
        let line = String::from_utf8_lossy(&line).trim().to_owned();
        match line.split_whitespace().collect::<Vec<_>>().as_slice() {
            ["#VRML_SIM", version, "utf8", ..] => Ok(Self { version: (*version).to_owned(), path }),
            _ => Err(WorldFileError::Header { name: name(), found: line }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_world_inside_is_opened() {
        let folder = tempfile::tempdir().unwrap();
        let inside = folder.path().join("project");
        std::fs::create_dir(&inside).unwrap();
        let write = |name: &str, text: &str| std::fs::write(inside.join(name), text).unwrap();
        write("good.wbt", "#VRML_SIM R2025a utf8\nWorldInfo {}\n");
        write("windows.wbt", "#VRML_SIM R2023b utf8\r\n");
        write("bad.wbt", "<html>");
        write("empty.wbt", "");
        std::fs::write(folder.path().join("outside.wbt"), "#VRML_SIM R2025a utf8\n").unwrap();
        for (target, link) in [
            ("../outside.wbt", "out.wbt"),
            ("/etc/passwd", "passwd.wbt"),
            ("good.wbt", "in.wbt"),
            ("nothing", "none.wbt"),
        ] {
            std::os::unix::fs::symlink(target, inside.join(link)).unwrap();
        }
        let open = |name: &str| WorldFile::open(&inside, &inside.join(name)).map(|world| world.version);
        assert_eq!(open("good.wbt").unwrap(), "R2025a");
        assert_eq!(open("windows.wbt").unwrap(), "R2023b");
        assert_eq!(open("in.wbt").unwrap(), "R2025a");
        assert_eq!(open("out.wbt"), Err(WorldFileError::Outside("out.wbt".to_owned())));
        assert_eq!(open("passwd.wbt"), Err(WorldFileError::Outside("passwd.wbt".to_owned())));
        assert_eq!(open("missing.wbt"), Err(WorldFileError::Missing("missing.wbt".to_owned())));
        assert_eq!(open("none.wbt"), Err(WorldFileError::Missing("none.wbt".to_owned())));
        assert!(matches!(open("bad.wbt"), Err(WorldFileError::Header { .. })));
        assert!(matches!(open("empty.wbt"), Err(WorldFileError::Header { .. })));
    }
}
