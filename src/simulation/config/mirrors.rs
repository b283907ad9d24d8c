//! The remote of a repository, or of its mirror. Pure.

use std::collections::BTreeMap;
use std::path::PathBuf;

use percent_encoding::{AsciiSet, CONTROLS, utf8_percent_encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::domain::{ProjectUrl, UrlPrefix};

/// The key `gitMirrors`: {URL prefix: replacement}. The longest prefix that covers a world's URL wins.
#[derive(Debug, Clone, Default, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "BTreeMap<String, String>", into = "BTreeMap<String, String>")]
pub struct Mirrors(Vec<(UrlPrefix, String)>);

/// The remote of a repository.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Remote {
    /// The URL or path for git.
    pub location: String,
    /// The one protocol that git may use for it.
    pub protocol: &'static str,
}

impl Remote {
    /// A key that is the same for every spelling of the repository: Git hosts ignore case and the ending `.git`.
    pub fn key(&self) -> String {
        if self.protocol == "file" {
            return self.location.clone();
        }
        let location = self.location.to_lowercase();
        location.trim_end_matches('/').trim_end_matches(".git").to_owned()
    }
}

/// The Git host that needs no mirror.
const GITHUB: &str = "https://github.com";

/// Characters that must be escaped in a path segment of a URL.
const ESCAPED: &AsciiSet = &CONTROLS
    .add(b' ')
    .add(b'"')
    .add(b'#')
    .add(b'%')
    .add(b'<')
    .add(b'>')
    .add(b'?')
    .add(b'`')
    .add(b'{')
    .add(b'}');

impl Mirrors {
    fn mirror(&self, world: &ProjectUrl) -> Option<&(UrlPrefix, String)> {
        self.0
            .iter()
            .filter(|(prefix, _)| prefix.covers(world))
            .max_by_key(|(prefix, _)| prefix.depth())
    }

    /// The same world in the repository that is fetched from this URL; `None` if no URL on its Git host leads to that.
    pub fn moved(&self, world: &ProjectUrl, location: &str) -> Option<ProjectUrl> {
        let mirror = self
            .mirror(world)
            .map(|(prefix, replacement)| (prefix.as_str(), replacement.as_str()));
        let (prefix, base) = mirror.unwrap_or((GITHUB, GITHUB));
        let base = url::Url::parse(base).ok()?;
        let rest = location
            .strip_prefix(base.as_str().trim_end_matches('/'))?
            .strip_prefix('/')?;
        let moved = world
            .in_repository(&format!("{}/{rest}", prefix.trim_end_matches('/')))
            .ok()?;
        let there = Remote {
            location: location.to_owned(),
            protocol: "https",
        };
        (self.remote(&moved)?.key() == there.key()).then_some(moved)
    }

    /// The remote of a world's repository; `None` for a Git host that is neither GitHub nor mirrored.
    pub fn remote(&self, world: &ProjectUrl) -> Option<Remote> {
        let Some((prefix, replacement)) = self.mirror(world) else {
            let location = format!("{GITHUB}/{}.git", escaped(world.repository_segments()));
            return (world.host() == "github.com").then_some(Remote {
                location,
                protocol: "https",
            });
        };
        let rest = prefix.rest_of_repository(world);
        if let Some(folder) = replacement.strip_prefix("file:") {
            let folder = PathBuf::from(folder.trim_start_matches("//"));
            let path: PathBuf = std::iter::once(folder.as_os_str())
                .chain(rest.iter().map(AsRef::as_ref))
                .collect();
            let location = std::path::absolute(&path)
                .unwrap_or(path)
                .to_string_lossy()
                .into_owned();
            return Some(Remote {
                location,
                protocol: "file",
            });
        }
        let slash = if rest.is_empty() || replacement.ends_with('/') {
            ""
        } else {
            "/"
        };
        Some(Remote {
            location: format!("{replacement}{slash}{}", escaped(rest)),
            protocol: "https",
        })
    }
}

fn escaped(segments: &[String]) -> String {
    segments
        .iter()
        .map(|segment| utf8_percent_encode(segment, ESCAPED).to_string())
        .collect::<Vec<_>>()
        .join("/")
}

impl TryFrom<BTreeMap<String, String>> for Mirrors {
    type Error = String;

    fn try_from(map: BTreeMap<String, String>) -> Result<Self, String> {
        map.into_iter()
            .map(|(prefix, replacement)| {
                let prefix = UrlPrefix::try_from(prefix)?;
                let replacement = shellexpand::full(&replacement)
                    .map_err(|error| format!("{replacement:?} names {}, which is not set", error.var_name))?
                    .into_owned();
                let names_something =
                    |begin: &str| replacement.strip_prefix(begin).is_some_and(|rest| !rest.is_empty());
                if names_something("file:") || names_something("https://") {
                    Ok((prefix, replacement))
                } else {
                    Err(format!(
                        "{replacement:?} is no replacement; allowed are https://... and file:FOLDER"
                    ))
                }
            })
            .collect::<Result<_, _>>()
            .map(Self)
    }
}

impl From<Mirrors> for BTreeMap<String, String> {
    fn from(mirrors: Mirrors) -> Self {
        mirrors
            .0
            .into_iter()
            .map(|(prefix, replacement)| (prefix.into(), replacement))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mirrors(pairs: &[(&str, &str)]) -> Result<Mirrors, String> {
        pairs
            .iter()
            .map(|(one, other)| ((*one).to_owned(), (*other).to_owned()))
            .collect::<BTreeMap<_, _>>()
            .try_into()
    }

    #[test]
    fn the_longest_prefix_wins() {
        let table = mirrors(&[
            ("https://github.com/", "https://mirror.lab/github"),
            ("https://github.com/lab", "file:/srv/lab"),
            ("https://github.com/lab/arm", "file:///srv/arm.git"),
            ("https://git.lab/", "https://git.lab/"),
        ])
        .unwrap();
        let of = |world: &str| {
            table
                .remote(&ProjectUrl::parse(world).unwrap())
                .map(|remote| remote.location)
        };
        let some = |text: &str| Some(text.to_owned());
        assert_eq!(
            of("https://github.com/x/y/blob/m/worlds/a.wbt"),
            some("https://mirror.lab/github/x/y")
        );
        assert_eq!(
            of("https://github.com/lab/leg/blob/m/worlds/a.wbt"),
            some("/srv/lab/leg")
        );
        assert_eq!(
            of("https://github.com/lab/arm/blob/m/worlds/a.wbt"),
            some("/srv/arm.git")
        );
        assert_eq!(
            of("https://git.lab/g/s/r/-/blob/m/worlds/a.wbt"),
            some("https://git.lab/g/s/r")
        );
        assert_eq!(of("https://elsewhere.org/u/r/blob/m/worlds/a.wbt"), None);
    }

    #[test]
    fn without_a_mirror_github_is_cloned_from_itself() {
        let world = ProjectUrl::parse("https://github.com/u/a%20b/blob/m/worlds/a.wbt").unwrap();
        let remote = Mirrors::default().remote(&world).unwrap();
        assert_eq!(
            remote,
            Remote {
                location: "https://github.com/u/a%20b.git".to_owned(),
                protocol: "https"
            }
        );
    }

    #[test]
    fn a_repository_is_the_same_in_every_spelling() {
        let key = |location: &str, protocol| {
            Remote {
                location: location.to_owned(),
                protocol,
            }
            .key()
        };
        let one = key("https://github.com/lab/arm.git", "https");
        assert_eq!(one, key("https://github.com/Lab/ARM", "https"));
        assert_ne!(key("/srv/lab/arm", "file"), key("/srv/Lab/arm", "file"));
    }

    #[test]
    fn only_https_and_folders_replace() {
        for odd in [
            "ext::sh -c id",
            "http://mirror",
            "ssh://mirror",
            "git@mirror:x",
            "/srv/x",
        ] {
            assert!(
                mirrors(&[("https://github.com/", odd)]).unwrap_err().contains(odd),
                "{odd}"
            );
        }
    }
}
