//! Lists of repositories that a server allows or blocks.

use serde::{Deserialize, Serialize};

use super::project_url::{ProjectUrl, ProjectUrlError, RefKind, owner, split_repository, split_url, without_git};

/// A URL prefix by whole path segments: `https://github.com/lab` covers `https://github.com/lab/x`, but not
/// `https://github.com/lab-evil/x` (the original compares characters, and accepts it).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct UrlPrefix {
    text: String,
    host: String,
    segments: Vec<String>,
    inside: Option<Inside>,
    /// The hash of host and owner; `None` if the prefix is a whole host.
    owner: Option<u64>,
}

/// A text of the configuration that is not a URL prefix.
#[derive(Debug, thiserror::Error)]
#[error("{text:?} is no URL prefix: {problem}; allowed are such as https://github.com/USER")]
pub struct UrlPrefixError {
    text: String,
    problem: String,
}

/// The part of a prefix within one repository, in any Git host's form of URL.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Inside {
    /// Number of segments that name the repository.
    repository: usize,
    /// Number of segments before the reference.
    reference: usize,
    kind: RefKind,
}

impl UrlPrefix {
    /// Whether this prefix covers a world's URL.
    ///
    /// Hosts, owners and repositories are compared case-insensitively, as the Git hosts do; the rest lies inside the
    /// repository, and git is case-sensitive. Of that part the reference and the directory count, not the marker before
    /// them: `tree`, `blob`, `-/blob` and `src/branch` mean the same.
    pub fn covers(&self, world: &ProjectUrl) -> bool {
        self.may_be_of(world)
            && self.host == world.host()
            && (self.covers_segments(world) || self.covers_inside(world, false))
    }

    /// Whether a world's URL may mean something that this prefix covers: `blob/v1` may mean the tag of `src/tag/v1`.
    pub fn may_cover(&self, world: &ProjectUrl) -> bool {
        self.may_be_of(world) && (self.covers(world) || (self.host == world.host() && self.covers_inside(world, true)))
    }

    /// Whether the owner may be the same. Most comparisons end here, without comparing text.
    fn may_be_of(&self, world: &ProjectUrl) -> bool {
        self.owner.is_none_or(|owner| owner == world.owner())
    }

    fn covers_segments(&self, world: &ProjectUrl) -> bool {
        let repository = world.repository_segments().len();
        self.segments.len() <= world.segments().len()
            && self.segments.iter().zip(world.segments()).enumerate().all(|(index, (ours, theirs))| {
                if index < repository { ours.eq_ignore_ascii_case(theirs) } else { ours == theirs }
            })
    }

    fn covers_inside(&self, world: &ProjectUrl, any_kind: bool) -> bool {
        let Some(Inside { repository, reference, kind }) = self.inside else {
            return false;
        };
        let (ours, theirs) = (self.segments.get(..repository).unwrap_or_default(), world.repository_segments());
        ours.len() == theirs.len()
            && ours.iter().zip(theirs).all(|(ours, theirs)| ours.eq_ignore_ascii_case(theirs))
            && (kind == RefKind::Any || kind == world.kind() || (any_kind && world.kind() == RefKind::Any))
            && world.inside().starts_with(self.segments.get(reference..).unwrap_or_default())
    }

    /// Number of path segments: the longer of two prefixes is the more specific one.
    pub fn depth(&self) -> usize {
        self.segments.len()
    }

    /// The path segments of a covered world's repository that come after this prefix.
    pub fn rest_of_repository<'world>(&self, world: &'world ProjectUrl) -> &'world [String] {
        world.repository_segments().get(self.segments.len()..).unwrap_or_default()
    }

    /// The prefix as configured.
    pub fn as_str(&self) -> &str {
        &self.text
    }
}

impl TryFrom<String> for UrlPrefix {
    type Error = UrlPrefixError;

    fn try_from(text: String) -> Result<Self, UrlPrefixError> {
        let wrong = |ProjectUrlError { problem }| UrlPrefixError { text: text.clone(), problem };
        let (host, mut segments) = split_url(text.trim_end_matches('/')).map_err(wrong)?;
        let inside = split_repository(&segments).ok();
        let inside = inside.map(|(repository, reference, kind)| Inside { repository, reference, kind });
        let repository = inside.as_ref().map_or(segments.len(), |inside| inside.repository);
        if repository >= 2
            && let Some(name) = segments.get_mut(repository - 1)
        {
            *name = without_git(name).map_err(wrong)?;
        }
        let owner = segments.first().map(|_| owner(&host, &segments));
        Ok(Self { text, host, segments, inside, owner })
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

    #[test]
    fn a_branch_is_the_same_in_every_form_of_url() {
        let world = |path: &str| ProjectUrl::parse(&format!("https://forge.org/lab/x/{path}/worlds/a.wbt")).unwrap();
        let forms = ["blob/evil", "tree/evil", "-/blob/evil", "-/tree/evil", "src/branch/evil"];
        for blocked in forms {
            for asked in forms {
                let prefix = prefix(&format!("https://forge.org/LAB/x.git/{blocked}"));
                assert!(prefix.may_cover(&world(asked)), "{blocked} and {asked}");
                assert!(prefix.may_cover(&world(&format!("{asked}/p"))), "{blocked} and a folder of {asked}");
                assert!(!prefix.may_cover(&world(&asked.replace("evil", "evil2"))), "{blocked} and not {asked}2");
            }
        }
        let tag = prefix("https://forge.org/lab/x/src/tag/v1");
        assert!(!tag.covers(&world("blob/v1")) && tag.may_cover(&world("blob/v1")), "it may mean the branch v1");
        assert!(!tag.may_cover(&world("src/branch/v1")));
        assert!(prefix("https://forge.org/lab/x/blob/main/p").covers(&world("src/branch/main/p/q")));
        assert!(!prefix("https://forge.org/lab/x/blob/main/p").covers(&world("-/blob/main/q")));
        let named_blob = "https://forge.org/g/s/blob/-/blob/main/worlds/a.wbt";
        assert!(prefix("https://forge.org/g/s/blob").covers(&ProjectUrl::parse(named_blob).unwrap()));
    }
}
