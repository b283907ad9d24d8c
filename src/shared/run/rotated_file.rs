//! A log file that is rotated by size. It never panics, and never exceeds its size limit by more than one write.
//!
//! Crates for this fail in one way or another: file-rotate 0.8 panics if a directory can't be read; with rolling-file
//! 0.2 and logroller 0.1, a file that can't be renamed grows without limit or is no longer written.

use std::fs::{File, Metadata};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// A file to which lines are appended. The previous file is `NAME.1`.
#[derive(Debug)]
pub struct RotatedFile {
    path: PathBuf,
    /// Size from which it is rotated, in bytes.
    max_size: u64,
    /// The first line of each file.
    heading: String,
    file: File,
    size: u64,
}

impl RotatedFile {
    /// Opens a file for appending, and creates its directory. Each file begins with the heading, and is rotated from
    /// `max_size` bytes on.
    ///
    /// # Errors
    /// When the directory can't be created, or the file can't be opened.
    pub fn open(path: &Path, max_size: u64, heading: impl Into<String>) -> io::Result<Self> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let file = File::options().create(true).append(true).open(path)?;
        let size = file.metadata()?.len();
        Ok(Self {
            path: path.to_owned(),
            max_size,
            heading: heading.into(),
            file,
            size,
        })
    }

    /// Continues with an empty file. A file that somebody has moved is left as it is.
    fn rotate(&mut self) -> io::Result<()> {
        if self.is_at_path() {
            let mut older = self.path.clone().into_os_string();
            older.push(".1");
            if std::fs::rename(&self.path, older).is_err() {
                // A file that can't be renamed must not grow without limit either.
                self.size = 0;
                return self.file.set_len(0);
            }
        }
        self.file = File::options().create(true).append(true).open(&self.path)?;
        self.size = self.file.metadata()?.len();
        Ok(())
    }

    /// Whether the file is still at its path.
    fn is_at_path(&self) -> bool {
        let identity = |about: Metadata| (about.dev(), about.ino());
        let own = self.file.metadata().map(identity);
        std::fs::metadata(&self.path)
            .map(identity)
            .is_ok_and(|there| own.is_ok_and(|own| own == there))
    }

    /// Appends all bytes or none: a truncated line would corrupt the next one.
    fn add(&mut self, bytes: &[u8]) -> io::Result<()> {
        if let Err(error) = self.file.write_all(bytes) {
            if self.is_at_path() {
                self.file.set_len(self.size)?;
            }
            return Err(error);
        }
        self.size += bytes.len() as u64;
        Ok(())
    }
}

impl Write for RotatedFile {
    /// Writes whole lines. Lines for which the disk has no space are lost.
    fn write(&mut self, lines: &[u8]) -> io::Result<usize> {
        if self.size >= self.max_size {
            self.rotate()?;
        }
        if self.size == 0 {
            self.add(self.heading.clone().as_bytes())?;
        }
        self.add(lines)?;
        Ok(lines.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_bounded_whatever_happens() {
        const MOST: u64 = 50_000;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("logs/a.log");
        let mut file = RotatedFile::open(&path, MOST, "").unwrap();
        let line = [b'x'; 1000];
        let size = |name: &str| std::fs::metadata(folder.path().join("logs").join(name)).map_or(0, |about| about.len());
        for _ in 0..210 {
            file.write_all(&line).unwrap();
        }
        for name in ["a.log", "a.log.1"] {
            assert!((1..=MOST + 1000).contains(&size(name)), "{name}: {}", size(name));
        }
        let before = size("a.log");
        drop(file);
        let mut file = RotatedFile::open(&path, MOST, "").unwrap();
        file.write_all(b"more").unwrap();
        assert_eq!(size("a.log"), before + 4);
        // The log can't be renamed to a directory that is not empty.
        std::fs::remove_file(folder.path().join("logs/a.log.1")).unwrap();
        std::fs::create_dir_all(folder.path().join("logs/a.log.1/full")).unwrap();
        for _ in 0..200 {
            file.write_all(&line).unwrap();
        }
        assert!(size("a.log") <= MOST + 1000);
        std::fs::remove_dir_all(folder.path().join("logs")).unwrap();
        for _ in 0..200 {
            file.write_all(&line).ok();
        }
    }
}
