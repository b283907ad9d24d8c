//! The display on which a simulation opens its window: one that is there, or a virtual one (Xvfb) in its sandbox.
//!
//! In a sandbox Xvfb is within the simulation's limits and its view of the files, and ends with it. It listens on a socket
//! in the sandbox's own `/tmp` alone, so that its number is always the same.

use std::ffi::OsString;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use which::which;

/// The display of a simulation.
#[derive(Debug)]
pub enum Display {
    /// It is there already; the variables by which programs find it.
    Outside(Vec<(OsString, OsString)>),
    /// It is started in the sandbox, before the program.
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
/// Starts Xvfb, waits until it says that it is ready, and then becomes the program that follows its own three arguments: the
/// number, Xvfb and the authority file. Xvfb has a session of its own: the SIGTERM for the program is not for it.
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

    /// The words that start it in a sandbox before the program.
    pub fn launcher(&self) -> Vec<OsString> {
        let Self::Inside { xvfb, authority } = self else { return Vec::new() };
        let words = ["/bin/sh", "-c", LAUNCHER, SCREEN, NAME].map(OsString::from);
        words.into_iter().chain([xvfb.into(), authority.into()]).collect()
    }

    /// Makes what it needs in the folder that is `/tmp` in the sandbox: an ordinary user's Xvfb does not make its own.
    pub fn prepare(&self, tmp: &Path) -> io::Result<()> {
        if matches!(self, Self::Outside(_)) {
            return Ok(());
        }
        let folder = tmp.join(".X11-unix");
        std::fs::create_dir_all(&folder)?;
        std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o1777))
    }
}
