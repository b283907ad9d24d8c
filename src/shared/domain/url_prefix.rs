//! Lists of repositories that a server allows or blocks.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::project_url::{ProjectUrl, ProjectUrlError, plain_repository, split_repository, split_url};

/// A URL prefix of whole path segments: a host, an owner or a repository. `https://github.com/lab` covers
/// `https://github.com/lab/x`, but not `https://github.com/lab-evil/x` (the original compares characters, and accepts
/// it).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct UrlPrefix {
    text: String,
    host: String,
    segments: Vec<String>,
}

impl UrlPrefix {
    /// Whether this prefix covers a world's repository. Names are compared case-insensitively, as the Git hosts do.
    pub fn covers(&self, world: &ProjectUrl) -> bool {
        let repository = world.repository_segments();
        self.host == world.host()
            && self.segments.len() <= repository.len()
            && self
                .segments
                .iter()
                .zip(repository)
                .all(|(ours, theirs)| ours.eq_ignore_ascii_case(theirs))
    }

    /// Number of path segments: the longer of two prefixes is the more specific one.
    pub fn depth(&self) -> usize {
        self.segments.len()
    }

    /// The path segments of a covered world's repository that come after this prefix.
    pub fn rest_of_repository<'world>(&self, world: &'world ProjectUrl) -> &'world [String] {
        world
            .repository_segments()
            .get(self.segments.len()..)
            .unwrap_or_default()
    }

    /// The prefix as configured.
    pub fn as_str(&self) -> &str {
        &self.text
    }
}

impl TryFrom<String> for UrlPrefix {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let wrong = |ProjectUrlError(problem)| {
            format!("{text:?} is no URL prefix: {problem}; allowed are such as https://github.com/USER")
        };
        let (host, mut segments) = split_url(&text).map_err(wrong)?;
        if text.contains(['*', '?', '#']) || split_repository(&segments).is_ok() {
            return Err(wrong(ProjectUrlError(
                "it names a part of a repository, or has *, ? or #".to_owned(),
            )));
        }
        if segments.len() >= 2 {
            segments = plain_repository(segments).map_err(wrong)?;
        }
        Ok(Self { text, host, segments })
    }
}

impl From<UrlPrefix> for String {
    fn from(prefix: UrlPrefix) -> Self {
        prefix.text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prefix(text: &str) -> UrlPrefix {
        UrlPrefix::try_from(text.to_owned()).unwrap()
    }

    #[test]
    fn a_prefix_covers_whole_path_segments_only() {
        let world =
            |path: &str| ProjectUrl::parse(&format!("https://github.com/{path}/blob/main/worlds/a.wbt")).unwrap();
        let table = [
            ("https://github.com/lab", "lab/x", true, "an owner"),
            (
                "https://github.com/lab/",
                "lab/x",
                true,
                "a slash at the end changes nothing",
            ),
            ("https://github.com/", "lab/x", true, "a whole host"),
            ("https://GitHub.com/LAB", "lab/x", true, "Git hosts ignore case"),
            (
                "https://github.com/lab",
                "lab-evil/x",
                false,
                "another owner with the same beginning",
            ),
            (
                "https://github.com/lab/x",
                "lab/xy",
                false,
                "another repository with the same beginning",
            ),
            (
                "https://github.com/lab/x.git",
                "lab/x",
                true,
                "git's ending changes nothing",
            ),
            (
                "https://github.com/lab/x",
                "lab/x.GIT.git",
                true,
                "nor does it in the world's URL",
            ),
            ("https://gitlab.com/lab", "lab/x", false, "another host"),
            ("https://github.com:444/lab", "lab/x", false, "another port"),
        ];
        for (text, path, covered, why) in table {
            assert_eq!(prefix(text).covers(&world(path)), covered, "{text} and {path}: {why}");
        }
    }

    #[test]
    fn a_part_of_a_repository_is_no_prefix() {
        for part in [
            "blob/main",
            "tree/main/p",
            "-/tree/main",
            "src/branch/main",
            "src/tag/v1",
        ] {
            let error = UrlPrefix::try_from(format!("https://forge.org/lab/x/{part}")).unwrap_err();
            assert!(error.contains("it names a part of a repository"), "{error}");
        }
    }
}
