//! What an X server leaves behind that was killed: its lock, `/tmp/.XN-lock`, and its socket, `/tmp/.X11-unix/XN`.
//! Nobody else could use the display's number again.

use std::collections::BTreeSet;
use std::path::Path;

use nix::errno::Errno;
use nix::sys::signal::kill;
use nix::unistd::Pid;

const FOLDER: &str = "/tmp";

/// Removes what these processes have left, as far as they have ended.
pub fn remove_of(ended: &BTreeSet<i32>) {
    remove_below(Path::new(FOLDER), ended);
}

fn remove_below(folder: &Path, ended: &BTreeSet<i32>) {
    let Ok(sockets) = std::fs::read_dir(folder.join(".X11-unix")) else {
        return;
    };
    for socket in sockets.flatten() {
        let name = socket.file_name();
        let Some(number) = name.to_str().and_then(|name| name.strip_prefix('X')?.parse::<u16>().ok()) else {
            continue;
        };
        let lock = folder.join(format!(".X{number}-lock"));
        // The lock holds the process that has the display.
        let owner = std::fs::read_to_string(&lock).ok().and_then(|text| text.trim().parse::<i32>().ok());
        if owner.is_some_and(|pid| ended.contains(&pid) && has_ended(pid)) {
            std::fs::remove_file(socket.path()).ok();
            std::fs::remove_file(lock).ok();
        }
    }
}

fn has_ended(pid: i32) -> bool {
    kill(Pid::from_raw(pid), None) == Err(Errno::ESRCH)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_belongs_to_an_ended_process_of_ours_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join(".X11-unix")).unwrap();
        let mut ours = std::process::Command::new("true").spawn().unwrap();
        ours.wait().unwrap();
        let (ours, living) = (ours.id().cast_signed(), std::process::id().cast_signed());
        for (number, pid) in [(1, ours), (2, living), (3, 1)] {
            std::fs::write(folder.path().join(format!(".X11-unix/X{number}")), "").unwrap();
            std::fs::write(folder.path().join(format!(".X{number}-lock")), format!("{pid:>10}\n")).unwrap();
        }
        remove_below(folder.path(), &BTreeSet::from([ours, living]));
        let is_left = |number: u16| {
            let (lock, socket) = (format!(".X{number}-lock"), format!(".X11-unix/X{number}"));
            (folder.path().join(lock).exists(), folder.path().join(socket).exists())
        };
        assert_eq!([1, 2, 3].map(is_left), [(false, false), (true, true), (true, true)]);
    }
}
