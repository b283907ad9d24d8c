//! The display on which a simulation opens its window: an existing one, or a virtual one (Xvfb) in its sandbox.
//!
//! In a sandbox Xvfb has the simulation's limits and its view of the files, and ends with it. It listens only on a
//! socket in the sandbox's own `/tmp`, so that its number is always the same.

use std::ffi::OsString;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use which::which;

/// The display of a simulation.
#[derive(Debug)]
pub enum Display {
    /// An existing display: the variables by which programs find it.
    Outside(Vec<(OsString, OsString)>),
    /// A virtual display, started in the sandbox before the program.
    Inside {
        /// The program of Xvfb.
        xvfb: PathBuf,
        /// The file that authorizes its users.
        authority: PathBuf,
    },
}

/// The only screen of a virtual display: width, height and bits of a pixel, as `xvfb-run` has it.
pub const SCREEN: &str = "1280x1024x24";
/// The name of the display in a sandbox.
const NAME: &str = ":99";
/// Starts Xvfb, waits until it reports that it is ready, and then becomes the program that follows its own three
/// arguments: the number, Xvfb and the authority file. Xvfb has a session of its own, so that the SIGTERM for the program
/// does not reach it.
const LAUNCHER: &str = r#"
ready=/tmp/.xvfb; log=/tmp/.xvfb.log
mkfifo "$ready" || exit
(setsid "$2" "$1" -screen 0 "$0" -nolisten tcp -nolisten local -fp built-ins -auth "$3" -displayfd 3 3>"$ready" >"$log" 2>&1 &)
if ! read -r number <"$ready"; then
    echo "The virtual display (Xvfb) can't be started: $(tail -n 1 "$log")" >&2
    exit 1
fi
rm -f "$ready"
shift 3
exec "$@"
"#;

impl Display {
    /// A virtual display that is started in the sandbox.
    ///
    /// # Errors
    /// When there is no Xvfb.
    pub fn inside(authority: PathBuf) -> io::Result<Self> {
        let xvfb = which("Xvfb").map_err(io::Error::other)?.canonicalize()?;
        Ok(Self::Inside { xvfb, authority })
    }

    /// The variables by which programs find it.
    pub fn variables(&self) -> Vec<(OsString, OsString)> {
        match self {
            Self::Outside(variables) => variables.clone(),
            Self::Inside { authority, .. } => {
                vec![("DISPLAY".into(), NAME.into()), ("XAUTHORITY".into(), authority.into())]
            }
        }
    }

    /// The command that precedes a program to start the display in its sandbox.
    pub fn launcher(&self) -> Vec<OsString> {
        let Self::Inside { xvfb, authority } = self else { return Vec::new() };
        let words = ["/bin/sh", "-c", LAUNCHER, SCREEN, NAME].map(OsString::from);
        words.into_iter().chain([xvfb.into(), authority.into()]).collect()
    }

    /// Makes the folder of its socket in the sandbox's `/tmp`, because Xvfb of an ordinary user does not.
    pub fn prepare(&self, tmp: &Path) -> io::Result<()> {
        if matches!(self, Self::Outside(_)) {
            return Ok(());
        }
        let folder = tmp.join(".X11-unix");
        std::fs::create_dir_all(&folder)?;
        std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o1777))
    }
}
