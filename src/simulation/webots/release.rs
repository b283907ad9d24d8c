//! Releases of Webots, and how they differ for this server.

use std::path::Path;

use crate::simulation::snapshot::SceneKind;

/// A release of Webots, such as `R2025a`. Releases are ordered by their age, the oldest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Release {
    year: u16,
    letter: char,
}

/// The first release that answers controllers before its world is ready.
const FIRST_ANSWERING: Release = Release {
    year: 2023,
    letter: 'b',
};
/// The first release whose 3D stream is `w3d`.
const FIRST_W3D: Release = Release {
    year: 2025,
    letter: 'a',
};

impl Release {
    /// Parses the name of a release; `None` for releases before 2019, which had other names, and anything else. What
    /// follows the name, such as ` revision 1`, is ignored.
    fn parse(text: &str) -> Option<Self> {
        let text = text.trim().strip_prefix('R')?;
        let (year, rest) = text.split_at_checked(4)?;
        let letter = rest.chars().next().filter(char::is_ascii_lowercase)?;
        Some(Self {
            year: year.parse().ok()?,
            letter,
        })
    }

    /// The release that simulates a world: the one installed in the directory of `program`, which also opens worlds of
    /// other releases; without an installation there, as in a container, the release that the world was made for.
    /// `None` if neither is known. Blocks.
    pub fn of_simulation(program: &Path, version_of_world: &str) -> Option<Self> {
        let installed = || {
            let folder = program.canonicalize().ok()?.parent()?.to_owned();
            let version = std::fs::read_to_string(folder.join("resources/version.txt")).ok()?;
            Self::parse(&version)
        };
        installed().or_else(|| Self::parse(version_of_world))
    }

    /// Whether this release answers controllers before its world is ready. Older ones crash.
    pub fn answers_during_start(release: Option<Self>) -> bool {
        release >= Some(FIRST_ANSWERING)
    }
}

impl SceneKind {
    /// The kind of scene that this release of Webots streams.
    pub fn of(release: Option<Release>) -> Self {
        if release >= Some(FIRST_W3D) {
            Self::W3d
        } else {
            Self::X3d
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_release_streams_one_kind_of_scene() {
        for (version, kind) in [
            ("V8.6.2", SceneKind::X3d),
            ("R2022b", SceneKind::X3d),
            ("R2023b revision 1", SceneKind::X3d),
            ("R2025a", SceneKind::W3d),
            ("R2025b-rev1", SceneKind::W3d),
            ("R2031a", SceneKind::W3d),
            ("R1", SceneKind::X3d),
            ("Rü025a", SceneKind::X3d),
        ] {
            assert_eq!(SceneKind::of(Release::parse(version)), kind, "{version}");
        }
    }

    #[test]
    fn the_installed_release_takes_precedence() {
        let home = tempfile::tempdir().unwrap();
        let program = home.path().join("webots");
        let release = |version_of_world| Release::of_simulation(&program, version_of_world);
        assert_eq!(release("R2023b"), Release::parse("R2023b"), "nothing is installed");
        std::fs::write(&program, "").unwrap();
        std::fs::create_dir(home.path().join("resources")).unwrap();
        std::fs::write(home.path().join("resources/version.txt"), "R2025a\n").unwrap();
        assert_eq!(release("R2023b"), Release::parse("R2025a"));
    }
}
