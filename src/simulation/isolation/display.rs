//! The display on which a simulation opens its window: an existing one, or a virtual one (Xvfb) of its own.
//!
//! Xvfb is a child of the program that uses it, with the same limits and view of the files, and the kernel kills it as
//! soon as that program has ended. It chooses a free number by itself and prints it (`-displayfd`). In this mode it
//! writes no lock file, and reuses the socket of an Xvfb that was killed.

use std::ffi::OsString;
use std::fs::{File, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use which::which;

/// The only authorization method that all programs and displays know.
const COOKIE: &str = "MIT-MAGIC-COOKIE-1";
/// In an authority file: the entry applies to every host. `FamilyWild` of X11/Xauth.h.
const EVERY_HOST: u16 = 0xffff;

/// The display of a simulation.
pub enum Display {
    /// An existing display, by its name.
    Outside(String),
    /// A virtual display, started before the program.
    Virtual {
        /// The program of Xvfb.
        xvfb: PathBuf,
        /// The file that authorizes its users.
        authority: PathBuf,
    },
}

/// Starts Xvfb, waits until it reports its number, and executes the program that follows the script's own three
/// arguments: Xvfb, the authority file, and options. At level `none` the pipe is in the instance's directory, and is
/// removed with it. Xvfb has a session of its own, so that the SIGTERM for the program does not reach it. Its screen
/// has the size and depth of that of `xvfb-run`.
const LAUNCHER: &str = r#"
folder=$(mktemp -d -p "${1%/*}" 2>/dev/null || mktemp -d) && mkfifo "$folder/ready" || exit
setpriv --pdeathsig KILL setsid "$0" -screen 0 1280x1024x24 -nolisten tcp $2 -fp built-ins -auth "$1" -displayfd 3 \
    3>"$folder/ready" >"$folder/log" 2>&1 &
read -r number <"$folder/ready"
why=$(tail -n 1 "$folder/log")
rm -r "$folder"
if [ -z "$number" ]; then
    echo "The virtual display (Xvfb) can't be started: $why" >&2
    exit 1
fi
export DISPLAY=":$number"
shift 2
exec "$@"
"#;

impl Display {
    /// A virtual display; its authority file is in the instance's directory.
    ///
    /// # Errors
    /// When there is no Xvfb, or the file can't be written.
    pub fn new_virtual(instance: &Path) -> io::Result<Self> {
        let xvfb = which("Xvfb")
            .map_err(|error| io::Error::other(format!("no Xvfb: {error}")))?
            .canonicalize()?;
        let authority = instance.join("Xauthority");
        let cookie: [u8; 16] = rand::random();
        let mut entry = EVERY_HOST.to_be_bytes().to_vec();
        // No address and no display number: the entry applies to all.
        for field in [&[], &[], COOKIE.as_bytes(), &cookie] {
            entry.extend(u16::try_from(field.len()).unwrap_or_default().to_be_bytes());
            entry.extend(field);
        }
        File::options()
            .create(true)
            .truncate(true)
            .write(true)
            .mode(0o600)
            .open(&authority)?
            .write_all(&entry)?;
        Ok(Self::Virtual { xvfb, authority })
    }

    /// The variable by which programs find it. The launcher of a virtual one sets `DISPLAY`.
    pub fn variable(&self) -> (OsString, OsString) {
        match self {
            Self::Outside(name) => ("DISPLAY".into(), name.into()),
            Self::Virtual { authority, .. } => ("XAUTHORITY".into(), authority.into()),
        }
    }

    /// The command that precedes a program to start its virtual display. In a sandbox Xvfb has no abstract socket, and
    /// a number that no display of the machine should have; outside, it finds a free number by its abstract socket.
    pub fn launcher(&self, in_sandbox: bool) -> Vec<OsString> {
        let Self::Virtual { xvfb, authority } = self else {
            return Vec::new();
        };
        let words = ["/bin/sh", "-c", LAUNCHER].map(OsString::from);
        let options = if in_sandbox { ":99 -nolisten local" } else { "" };
        words
            .into_iter()
            .chain([xvfb.into(), authority.into(), options.into()])
            .collect()
    }

    /// Creates the directory of its socket in the sandbox's `/tmp`, because Xvfb of an ordinary user does not.
    pub fn prepare(&self, tmp: &Path) -> io::Result<()> {
        let folder = tmp.join(".X11-unix");
        if matches!(self, Self::Outside(_)) {
            return Ok(());
        }
        std::fs::create_dir_all(&folder)?;
        std::fs::set_permissions(folder, Permissions::from_mode(0o1777))
    }
}
