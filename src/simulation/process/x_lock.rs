//! What an X server leaves behind that was killed: its lock, `/tmp/.XN-lock`, and its socket, `/tmp/.X11-unix/XN`.
//! Nobody else could use the display's number again.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use nix::errno::Errno;
use nix::fcntl::OFlag;
use nix::sys::signal::kill;
use nix::unistd::{Pid, getuid};

const FOLDER: &str = "/tmp";
/// A lock holds ten digits and a line feed.
const LONGEST: u64 = 64;
/// Everybody may put files beside the sockets: so many are looked at.
const MOST: usize = 4096;

/// Removes what these processes have left, as far as they have ended. Waits for nothing that others may have put there.
pub fn remove_of(ended: &BTreeSet<i32>) {
    remove_below(Path::new(FOLDER), ended);
}

fn remove_below(folder: &Path, ended: &BTreeSet<i32>) {
    if ended.is_empty() {
        return;
    }
    let Ok(sockets) = std::fs::read_dir(folder.join(".X11-unix")) else {
        return;
    };
    for socket in sockets.take(MOST).flatten() {
        let name = socket.file_name();
        let Some(number) = name.to_str().and_then(|name| name.strip_prefix('X')?.parse::<u16>().ok()) else {
            continue;
        };
        let lock = folder.join(format!(".X{number}-lock"));
        // The lock holds the process that has the display.
        if owner(&lock).is_some_and(|pid| ended.contains(&pid) && has_ended(pid)) {
            std::fs::remove_file(socket.path()).ok();
            std::fs::remove_file(lock).ok();
        }
    }
}

/// The process that a lock of this user names. Anybody may have put something else there: a pipe, a link, a large file.
fn owner(lock: &Path) -> Option<i32> {
    let flags = OFlag::O_NONBLOCK | OFlag::O_NOFOLLOW | OFlag::O_NOCTTY;
    let file = File::options().read(true).custom_flags(flags.bits()).open(lock).ok()?;
    let about = file.metadata().ok()?;
    if !about.is_file() || about.uid() != getuid().as_raw() || about.len() > LONGEST {
        return None;
    }
    let mut text = String::new();
    file.take(LONGEST).read_to_string(&mut text).ok()?;
    text.trim().parse().ok()
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
    #[test]
    fn what_is_no_lock_is_neither_waited_for_nor_removed() {
        let folder = tempfile::tempdir().unwrap();
        let sockets = folder.path().join(".X11-unix");
        std::fs::create_dir(&sockets).unwrap();
        let mut ours = std::process::Command::new("true").spawn().unwrap();
        ours.wait().unwrap();
        let ours = ours.id().cast_signed();
        let locks = [1, 2, 3, 4, 5].map(|number| {
            std::fs::write(sockets.join(format!("X{number}")), "").unwrap();
            folder.path().join(format!(".X{number}-lock"))
        });
        let [pipe, endless, link, large, right] = &locks;
        nix::unistd::mkfifo(pipe, nix::sys::stat::Mode::S_IRWXU).unwrap();
        std::os::unix::fs::symlink("/dev/zero", endless).unwrap();
        std::os::unix::fs::symlink(right, link).unwrap();
        std::fs::write(large, format!("{ours:>100}\n")).unwrap();
        std::fs::write(right, format!("{ours:>10}\n")).unwrap();
        let (sender, done) = std::sync::mpsc::channel();
        let path = folder.path().to_owned();
        std::thread::spawn(move || {
            remove_below(&path, &BTreeSet::from([ours]));
            sender.send(()).unwrap();
        });
        done.recv_timeout(std::time::Duration::from_secs(10)).unwrap();
        assert_eq!(locks.map(|lock| lock.symlink_metadata().is_ok()), [true, true, true, true, false]);
    }
}
