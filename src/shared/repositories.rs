//! Lists of repositories that a server allows or blocks.

use serde::{Deserialize, Serialize};

use super::project_url::{NoProject, ProjectUrl, split_url, without_git};

/// A URL prefix by whole path segments: `https://github.com/lab` covers `https://github.com/lab/x`, and not
/// `https://github.com/lab-evil/x` (the original compares letters, and lets that pass).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct UrlPrefix {
    text: String,
    host: String,
    segments: Vec<String>,
}

impl UrlPrefix {
    /// Whether this prefix covers a world's URL.
    ///
    /// Hosts, owners and repositories are compared without regard to case, for the forges do so too; what follows
    /// them lies inside the repository, where git tells cases apart. `tree` and `blob` name the same place.
    #[must_use]
    pub fn covers(&self, world: &ProjectUrl) -> bool {
        let canonical = |segment: &str| if segment == "tree" { "blob".to_owned() } else { segment.to_owned() };
        let repository = world.repository_segments();
        self.host == world.host()
            && self.segments.len() <= world.segments().len()
            && self.segments.iter().zip(world.segments()).enumerate().all(|(index, (ours, theirs))| {
                if index < repository.len() {
                    ours.eq_ignore_ascii_case(theirs)
                } else {
                    canonical(ours) == canonical(theirs)
                }
            })
    }

    /// How many path segments this prefix has: the longer of two prefixes is the more exact one.
    #[must_use]
    pub fn depth(&self) -> usize {
        self.segments.len()
    }

    /// The path segments of a covered world's repository that come after this prefix.
    #[must_use]
    pub fn rest_of_repository<'world>(&self, world: &'world ProjectUrl) -> &'world [String] {
        world.repository_segments().get(self.segments.len()..).unwrap_or_default()
    }

    /// The prefix as it was written.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.text
    }
}

impl TryFrom<String> for UrlPrefix {
    type Error = NoProject;

    fn try_from(text: String) -> Result<Self, NoProject> {
        let (host, mut segments) = split_url(text.trim_end_matches('/'))?;
        if segments.len() >= 2
            && let Some(name) = segments.last_mut()
        {
            *name = without_git(name)?;
        }
        Ok(Self { text, host, segments })
    }
}

impl From<UrlPrefix> for String {
    fn from(prefix: UrlPrefix) -> Self {
        prefix.text
    }
}

/// Whether any of these prefixes covers a world's URL.
#[must_use]
pub fn any_covers(prefixes: &[UrlPrefix], world: &ProjectUrl) -> bool {
    prefixes.iter().any(|prefix| prefix.covers(world))
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
            ("https://github.com/lab/", "lab/x", true, "a slash at the end changes nothing"),
            ("https://github.com/", "lab/x", true, "a whole host"),
            ("https://GitHub.com/LAB", "lab/x", true, "forges don't tell cases apart"),
            ("https://github.com/lab", "lab-evil/x", false, "another owner with the same beginning"),
            ("https://github.com/lab/x", "lab/xy", false, "another repository with the same beginning"),
            ("https://github.com/lab/x/tree/main", "lab/x", true, "tree and blob are the same place"),
            ("https://github.com/lab/x/blob/next", "lab/x", false, "another branch"),
            ("https://github.com/lab/x.git", "lab/x", true, "git's ending changes nothing"),
            ("https://github.com/lab/x", "lab/x.git", true, "nor does it in the world's URL"),
            ("https://gitlab.com/lab", "lab/x", false, "another host"),
            ("https://github.com:444/lab", "lab/x", false, "another port"),
        ];
        for (text, path, covered, why) in table {
            assert_eq!(prefix(text).covers(&world(path)), covered, "{text} and {path}: {why}");
        }
    }
}
