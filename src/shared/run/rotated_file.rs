//! A log file that is rotated by size. It never panics, and never exceeds its size limit by more than one write.
//!
//! Crates for this fail in one way or another: file-rotate 0.8 panics if a directory can't be read; with rolling-file
//! 0.2 and logroller 0.1, a file that can't be renamed grows without limit or is no longer written.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Size from which a file is rotated, in bytes. The Python servers have the same limit.
const FILE_SIZE: u64 = 500_000;

/// A file to which lines are appended. Beside it are rotated ones: `NAME.1` is the newest, then `NAME.2` and so on.
#[derive(Debug)]
pub struct RotatedFile {
    path: PathBuf,
    old_files: usize,
    file: File,
    size: u64,
    /// The first line of each file.
    heading: &'static str,
}

impl RotatedFile {
    /// Opens a file for appending, and creates its directory. `old_files` rotated ones are kept.
    ///
    /// # Errors
    /// When the directory can't be created, or the file can't be opened.
    pub fn open(path: &Path, old_files: usize) -> io::Result<Self> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let file = File::options().create(true).append(true).open(path)?;
        let size = file.metadata()?.len();
        Ok(Self { path: path.to_owned(), old_files, file, size, heading: "" })
    }

    /// The same with a first line for each file.
    pub fn with_heading(self, heading: &'static str) -> Self {
        Self { heading, ..self }
    }

    fn rotate(&mut self) -> io::Result<()> {
        let names: Vec<PathBuf> = (0..=self.old_files).map(|age| self.older(age)).collect();
        for (newer, older) in names.iter().zip(names.iter().skip(1)).rev() {
            match std::fs::rename(newer, older) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        self.file = File::options().create(true).append(true).open(&self.path)?;
        Ok(())
    }

    /// Appends all bytes or none: a truncated line would corrupt the next one.
    fn add(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes).inspect_err(|_| drop(self.file.set_len(self.size)))?;
        self.size += bytes.len() as u64;
        Ok(())
    }

    fn older(&self, age: usize) -> PathBuf {
        let mut name = OsString::from(&self.path);
        if age > 0 {
            name.push(format!(".{age}"));
        }
        name.into()
    }
}

impl Write for RotatedFile {
    /// Writes whole lines. Lines for which the disk has no space are lost.
    fn write(&mut self, lines: &[u8]) -> io::Result<usize> {
        if self.size >= FILE_SIZE {
            // A file that can't be renamed must not grow without limit either.
            if self.rotate().is_err() {
                self.file.set_len(0)?;
            }
            self.size = 0;
        }
        if self.size == 0 {
            self.add(self.heading.as_bytes())?;
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
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("logs/a.log");
        let mut file = RotatedFile::open(&path, 2).unwrap();
        let line = [b'x'; 999];
        let size = |name: &str| std::fs::metadata(folder.path().join("logs").join(name)).map_or(0, |about| about.len());
        for _ in 0..2100 {
            file.write_all(&line).unwrap();
            file.write_all(b"\n").unwrap();
        }
        for name in ["a.log", "a.log.1", "a.log.2"] {
            assert!((1..=FILE_SIZE + 1000).contains(&size(name)), "{name}: {}", size(name));
        }
        assert_eq!(size("a.log.3"), 0);
        let before = size("a.log");
        drop(file);
        RotatedFile::open(&path, 2).unwrap().write_all(b"more").unwrap();
        assert_eq!(size("a.log"), before + 4);
        // The older ones can't be renamed.
        let mut file = RotatedFile::open(&path, 2).unwrap();
        std::fs::remove_file(folder.path().join("logs/a.log.2")).unwrap();
        std::fs::create_dir_all(folder.path().join("logs/a.log.2/full")).unwrap();
        for _ in 0..2000 {
            file.write_all(&line).unwrap();
        }
        assert!(size("a.log") <= FILE_SIZE + 1000);
        std::fs::remove_dir_all(folder.path().join("logs")).unwrap();
        for _ in 0..2000 {
            file.write_all(&line).ok();
        }
    }
}
