//! The commit that a world's URL means, and its contents: arguments for git, and parsers of its answers. Pure.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::repository::REMOTE;
use crate::shared::domain::{ProjectUrl, Reading};

/// One commit that a world's URL may mean.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Revision {
    /// The hash of a commit, or of an annotated tag of one.
    pub commit: String,
    /// Branch, tag or commit, as in the URL.
    pub name: String,
    /// The project's directory; empty for the root.
    pub folder: String,
    /// Why the commit is trusted to be the repository's own.
    pub trust: TrustSource,
}

/// The commits that a world's URL may mean, as its remote has said.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Tip(pub(super) Arc<[Revision]>);

/// Why a commit is trusted to be the repository's own. Git hosts also serve commits of forks and of proposals by their
/// hash, which the repository's owner never accepted: allowing a repository must not allow those.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TrustSource {
    /// The remote reports it as the newest commit of a branch or tag.
    Tip,
    /// Only the URL names it: it must be found in the branches and tags before it is fetched.
    Url,
    /// The configuration allows any commit.
    AnyCommit,
}

/// Lists all branches and tags of the remote.
pub const LIST_TIPS: [&str; 6] = ["ls-remote", "--quiet", "--heads", "--tags", "--", REMOTE];

/// The commit that a URL names by its full hash, which needs no query of the remote. With `allow_any` it need not be in
/// a branch or tag.
pub fn commit_of(world: &ProjectUrl, allow_any: bool) -> Option<Revision> {
    let Reading { reference, folder } = world.candidates().into_iter().next()?;
    let trust = if allow_any {
        TrustSource::AnyCommit
    } else {
        TrustSource::Url
    };
    is_hash(&reference).then(|| Revision {
        commit: reference.to_ascii_lowercase(),
        name: reference,
        folder,
        trust,
    })
}

fn is_hash(text: &str) -> bool {
    text.len() == 40 && text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Fetches all branches and tags: only their commits if the remote supports that, otherwise everything.
pub fn fetch_history() -> Vec<String> {
    fetch(
        &["--filter=tree:0", "--prune"],
        &["+refs/heads/*:refs/heads/*", "+refs/tags/*:refs/tags/*"],
    )
}

/// Fetches these references with these options.
fn fetch(options: &[&str], references: &[&str]) -> Vec<String> {
    let common = ["--no-tags", "--no-write-fetch-head", "--progress", "--", REMOTE];
    [&["fetch"], options, &common, references]
        .concat()
        .into_iter()
        .map(str::to_owned)
        .collect()
}

/// Lists the branches and tags of the remote that URLs of its worlds may mean.
pub fn search_arguments<'world>(worlds: impl IntoIterator<Item = &'world ProjectUrl>) -> Vec<String> {
    let readings = worlds.into_iter().flat_map(ProjectUrl::candidates);
    let names: BTreeSet<String> = readings.flat_map(|reading| full_names(&reading)).collect();
    ["ls-remote", "--quiet", "--", REMOTE]
        .map(str::to_owned)
        .into_iter()
        .chain(names)
        .collect()
}

fn full_names(reading: &Reading) -> [String; 2] {
    [
        format!("refs/heads/{}", reading.reference),
        format!("refs/tags/{}", reading.reference),
    ]
}

/// Parses the answer to [`search_arguments`]: what the remote has, the longest names first, branches before tags.
pub fn found(world: &ProjectUrl, answer: &str) -> Vec<Revision> {
    let known: Vec<(&str, &str)> = answer.lines().filter_map(|line| line.split_once('\t')).collect();
    let readings = world.candidates().into_iter().rev();
    readings
        .flat_map(|reading| {
            full_names(&reading)
                .into_iter()
                .map(move |name| (name, reading.clone()))
        })
        .filter_map(|(name, reading)| {
            let (commit, _) = known.iter().find(|(_, known)| *known == name)?;
            is_hash(commit).then(|| Revision {
                commit: (*commit).to_owned(),
                name: reading.reference,
                folder: reading.folder,
                trust: TrustSource::Tip,
            })
        })
        .collect()
}

impl Revision {
    /// Its reference in the cached repository. A commit that only `anyCommit` allows has a separate one, so that it
    /// does not run once that key is off.
    pub fn reference(&self) -> String {
        let kind = if self.trust == TrustSource::AnyCommit {
            "any"
        } else {
            "fleet"
        };
        format!("refs/{kind}/{}", self.commit)
    }

    /// Fetches this commit alone.
    pub fn fetch_arguments(&self) -> Vec<String> {
        fetch(&["--depth=1"], &[&format!("+{}:{}", self.commit, self.reference())])
    }

    /// Lists an entry of the repository, and everything directly in the directories above the project's.
    pub fn list_arguments(&self, path: &str) -> Vec<String> {
        let root = (!self.folder.is_empty()).then_some(".".to_owned());
        let above = self
            .folder
            .match_indices('/')
            .filter_map(|(end, _)| Some(format!("{}/", self.folder.get(..end)?)));
        let fixed = ["ls-tree", "-z", "--full-tree", &self.reference(), "--", path].map(str::to_owned);
        fixed.into_iter().chain(root).chain(above).collect()
    }

    /// Parses the answer: the files directly in the directories above the project's, each path ended by a zero byte;
    /// `None` if there is no file at `path`.
    pub fn files_above(&self, answer: &[u8], path: &str) -> Option<Vec<u8>> {
        let is_file = |entry: &&[u8]| entry.starts_with(b"100") || entry.starts_with(b"120");
        let files = answer.split(|byte| *byte == 0).filter(is_file);
        let mut paths: Vec<&[u8]> = files
            .filter_map(|entry| entry.splitn(2, |byte| *byte == b'\t').nth(1))
            .collect();
        let is_there = paths.contains(&path.as_bytes());
        let folder = self.folder.as_bytes();
        paths.retain(|path| match path.iter().rposition(|byte| *byte == b'/') {
            Some(end) => path.get(..=end).is_some_and(|above| folder.starts_with(above)),
            None => !folder.is_empty(),
        });
        is_there.then(|| {
            paths
                .into_iter()
                .flat_map(|path| path.iter().chain(&[0]))
                .copied()
                .collect()
        })
    }

    /// The path in the repository of a file of the project.
    pub fn path_of(&self, file: &str) -> String {
        let slash = if self.folder.is_empty() { "" } else { "/" };
        format!("{}{slash}{file}", self.folder)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: &str = "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa";
    const B: &str = "bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb";

    fn world(path: &str) -> ProjectUrl {
        ProjectUrl::parse(&format!("https://github.com/u/r/{path}")).unwrap()
    }

    #[test]
    fn a_branch_with_slashes_is_preferred_to_a_shorter_tag() {
        let url = world("blob/feature/arm/lab/worlds/a.wbt");
        let answer =
            format!("{A}\trefs/tags/feature\n{B}\trefs/heads/feature/arm\n{B}\trefs/heads/x/refs/heads/feature\n");
        let found: Vec<_> = found(&url, &answer)
            .into_iter()
            .map(|one| (one.commit, one.name, one.folder))
            .collect();
        let expected = [(B, "feature/arm", "lab"), (A, "feature", "arm/lab")];
        assert_eq!(
            found,
            expected.map(|(commit, name, folder)| (commit.to_owned(), name.to_owned(), folder.to_owned()))
        );
    }

    #[test]
    fn an_answer_that_is_no_hash_is_never_used() {
        let url = world("blob/main/worlds/a.wbt");
        assert_eq!(found(&url, "--upload-pack=evil\trefs/heads/main\n"), []);
        assert_eq!(found(&url, "nonsense"), []);
    }
}
