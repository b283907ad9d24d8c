//! Whether this machine is why something has failed, by what calls of the server's own observe at that moment.
//!
//! Texts that git, Docker or a project have printed decide nothing here: a file of a project may be named like the
//! message of a full disk.

use std::io::{self, ErrorKind, Write};
use std::path::Path;
use std::time::Duration;

use super::disk_usage::DiskRoom;
use super::process_group::ExitReason;
use super::runner::{Ran, Run};
use crate::shared::domain::{Failure, Reason};

/// Bytes that are written to see whether the disk takes any. An empty file can be created on a full disk.
const WRITTEN: usize = 1 << 20;
/// Timeout of a program that only prints its version.
const VERSION: Duration = Duration::from_secs(10);

/// The failure that a call of the server's own on its disk has returned. The message does not contain a path.
pub fn own_call_failed(error: &io::Error) -> Failure {
    let (reason, why) = match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => (Reason::DiskFull, "its disk is full".to_owned()),
        kind => (Reason::ServerFault, kind.to_string()),
    };
    Failure::new(
        reason,
        format!("This simulation server can't write in its cache: {why}"),
    )
}

/// Why the disk of a directory can't be written at this moment; `None` if it can. `reserve` is `diskReserve`. Blocks.
pub fn disk_fault(folder: &Path, reserve: u64) -> Option<Failure> {
    let written = write(folder);
    if let Some(left) = DiskRoom::of(folder).ok().and_then(|room| room.shortage(reserve)) {
        let message = format!("This simulation server's disk is full: less than {left}");
        return Some(Failure::new(Reason::DiskFull, message));
    }
    written.err().map(|error| own_call_failed(&error))
}

/// Why this program can't be started at this moment: it is missing, or the system starts no more processes. Blocks.
pub fn start_fault(program: &str) -> Option<Failure> {
    let why = match Run::new([program, "--version"], Path::new("/"), VERSION).run_blocking(drop) {
        Ok(Ran {
            ending: ExitReason::Code(0),
            ..
        }) => return None,
        Ok(Ran { ending, .. }) => ending.to_string(),
        Err(error) => error.to_string(),
    };
    let message = format!("{program} does not work on this simulation server: {program} {why}");
    Some(Failure::new(Reason::ServerFault, message))
}

/// Writes a file without a name, which is gone afterwards, and waits until it is on the disk.
fn write(folder: &Path) -> io::Result<()> {
    std::fs::create_dir_all(folder)?;
    let mut file = tempfile::tempfile_in(folder)?;
    file.write_all(&vec![0; WRITTEN])?;
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_disk_takes_decides() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(disk_fault(folder.path(), 0), None);
        // No disk has this much room.
        let full = disk_fault(folder.path(), 1 << 40).unwrap();
        assert_eq!(full.reason, Reason::DiskFull);
        // Nothing can be created there, not even by root.
        let closed = disk_fault(Path::new("/proc/self/none"), 0).unwrap();
        assert_eq!(closed.reason, Reason::ServerFault);
        assert!(!closed.message.contains("/proc"), "{closed}");
    }

    #[test]
    fn a_program_that_can_not_be_started_is_the_servers_fault() {
        assert_eq!(start_fault("git"), None);
        let missing = start_fault("/nowhere/git").unwrap();
        assert_eq!(missing.reason, Reason::ServerFault);
    }
}
