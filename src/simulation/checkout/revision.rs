//! Which commit a world's URL means, and what lies in it: arguments for git and the reading of its answers. Pure.

use std::ffi::OsString;

use crate::shared::domain::{ProjectUrl, Reading, RefKind};

/// One commit that a world's URL may mean.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Revision {
    /// The object that git names: a commit, or the tag that stands for one.
    pub commit: String,
    /// Branch, tag or commit, as the URL has it.
    pub name: String,
    /// What is asked for on the remote.
    remote_name: String,
    /// Whether it need not be one that the repository's owner has accepted.
    is_any: bool,
    /// The project's folder; empty for the root.
    pub folder: String,
    /// Whether more than that folder is needed: a link on the way to the world may lead anywhere in the repository.
    pub is_whole: bool,
}

/// All of a repository, as git wants it named.
pub const ALL: &str = ".";
/// How many readings of a URL are looked for: no real branch has more slashes in its name.
const MOST_READINGS: usize = 12;

/// The commit that a URL names by its full hash: then nobody need be asked what it is. `is_any` tells whether any will
/// do, or only one that is in a branch or tag.
#[must_use]
pub fn commit_of(world: &ProjectUrl, is_any: bool) -> Option<Revision> {
    let Reading { reference, folder } = world.candidates().into_iter().next()?;
    let is_hash = [40, 64].contains(&reference.len()) && reference.bytes().all(|byte| byte.is_ascii_hexdigit());
    let kind = matches!(world.kind(), RefKind::Any | RefKind::Commit);
    let commit = reference.to_ascii_lowercase();
    (is_hash && kind).then(|| Revision {
        remote_name: commit.clone(),
        name: reference,
        commit,
        folder,
        is_any,
        is_whole: false,
    })
}

/// Makes a bare repository whose hashes are of the same kind as a commit's. git before 2.29 knows only the older kind,
/// and no name for it.
#[must_use]
pub fn init_arguments(commit: &str) -> Vec<OsString> {
    let kind = (commit.len() == 64).then_some("--object-format=sha256");
    ["init", "--quiet", "--bare"].into_iter().chain(kind).map(OsString::from).collect()
}

/// Asks the remote for all its branches and tags.
#[must_use]
pub fn tips_arguments(location: &str) -> Vec<OsString> {
    ["ls-remote", "--quiet", "--heads", "--tags", "--", location].map(OsString::from).to_vec()
}

/// Whether a commit is the newest of a branch or tag in such an answer.
#[must_use]
pub fn is_tip(answer: &str, commit: &str) -> bool {
    let tips = answer.lines().filter_map(|line| line.split_once('\t'));
    let accepted = |name: &str| name.starts_with("refs/heads/") || name.starts_with("refs/tags/");
    tips.filter(|(_, name)| accepted(name)).any(|(tip, _)| tip == commit)
}

/// Whether the remote's hashes have another length than this one: then it can't have that commit.
#[must_use]
pub fn is_of_other_length(answer: &str, commit: &str) -> bool {
    let mut tips = answer.lines().filter_map(|line| line.split_once('\t')).peekable();
    tips.peek().is_some() && tips.all(|(tip, _)| tip.len() != commit.len())
}

/// Fetches all branches and tags from the remote of this name: only their commits where it can do that, else
/// everything. git keeps note of that only for remotes that have a name.
#[must_use]
pub fn history_arguments(remote: &str) -> Vec<OsString> {
    let options = ["fetch", "--filter=tree:0", "--prune", "--no-tags", "--no-write-fetch-head", "--progress", "--"];
    let all = ["+refs/heads/*:refs/heads/*", "+refs/tags/*:refs/tags/*"];
    options.into_iter().chain([remote]).chain(all).map(OsString::from).collect()
}

/// Names a branch or tag of a fetched history in which a commit is.
#[must_use]
pub fn reachable_arguments(commit: &str) -> Vec<OsString> {
    let fixed = ["for-each-ref", "--count=1", "--contains", commit, "refs/heads", "refs/tags"];
    fixed.map(OsString::from).to_vec()
}

/// Asks the remote for all branches and tags that a URL may mean.
#[must_use]
pub fn search_arguments(world: &ProjectUrl, location: &str) -> Vec<OsString> {
    let names = world.candidates().into_iter().take(MOST_READINGS).flat_map(|reading| full_names(world, &reading));
    let fixed = ["ls-remote", "--quiet", "--", location].map(OsString::from);
    fixed.into_iter().chain(names.map(OsString::from)).collect()
}

fn full_names(world: &ProjectUrl, reading: &Reading) -> Vec<String> {
    let branch = format!("refs/heads/{}", reading.reference);
    let tag = format!("refs/tags/{}", reading.reference);
    match world.kind() {
        RefKind::Any => vec![branch, tag],
        RefKind::Branch => vec![branch],
        RefKind::Tag => vec![tag],
        RefKind::Commit => Vec::new(),
    }
}

/// What the remote has of what was asked for: the longest names first, branches before tags.
#[must_use]
pub fn found(world: &ProjectUrl, answer: &str) -> Vec<Revision> {
    let known: Vec<(&str, &str)> = answer.lines().filter_map(|line| line.split_once('\t')).collect();
    let readings = world.candidates().into_iter().take(MOST_READINGS).rev();
    readings
        .flat_map(|reading| full_names(world, &reading).into_iter().map(move |name| (name, reading.clone())))
        .filter_map(|(name, reading)| {
            let (commit, _) = known.iter().find(|(_, known)| *known == name)?;
            let is_hash = commit.len() >= 40 && commit.bytes().all(|byte| byte.is_ascii_hexdigit());
            is_hash.then(|| Revision {
                commit: (*commit).to_owned(),
                name: reading.reference,
                remote_name: name,
                folder: reading.folder,
                is_any: false,
                is_whole: false,
            })
        })
        .collect()
}

impl Revision {
    /// Whether the URL names a commit, not a branch or tag.
    #[must_use]
    pub fn is_commit(&self) -> bool {
        self.remote_name == self.commit
    }

    /// Its name in the cached repository. What was accepted because any commit is may not be taken for more later.
    #[must_use]
    pub fn reference(&self) -> String {
        format!("refs/{}/{}", if self.is_any { "any" } else { "fleet" }, self.commit)
    }

    /// Where a fetch puts it until it is known what came: a branch may have moved since the remote was asked.
    #[must_use]
    pub fn incoming(&self) -> String {
        format!("refs/incoming/{}", self.commit)
    }

    /// The same name with the object that came.
    #[must_use]
    pub fn with_commit(&self, commit: String) -> Self {
        let remote_name = if self.is_commit() { commit.clone() } else { self.remote_name.clone() };
        Self { commit, remote_name, ..self.clone() }
    }

    /// Fetches this commit alone.
    #[must_use]
    pub fn fetch_arguments(&self, location: &str) -> Vec<OsString> {
        let refspec = format!("+{}:{}", self.remote_name, self.incoming());
        let options = ["fetch", "--depth=1", "--no-tags", "--no-write-fetch-head", "--progress", "--"];
        options.into_iter().map(OsString::from).chain([location.into(), refspec.into()]).collect()
    }

    /// The same with all of the repository.
    #[must_use]
    pub fn whole(&self) -> Self {
        Self { is_whole: true, ..self.clone() }
    }

    /// The folder to check out, as git wants it named.
    #[must_use]
    pub fn needed(&self) -> &str {
        if self.is_whole || self.folder.is_empty() { ALL } else { &self.folder }
    }

    /// Lists the files of the project, or of the repository.
    #[must_use]
    pub fn list_arguments(&self) -> Vec<OsString> {
        let fixed = ["ls-tree", "-r", "-l", "-z", "--full-tree", &self.reference(), "--"].map(OsString::from);
        let folder = (self.needed() != ALL).then(|| OsString::from(format!("{}/", self.folder)));
        fixed.into_iter().chain(folder).collect()
    }

    /// Asks what kind of object stands behind the name.
    #[must_use]
    pub fn kind_arguments(&self) -> Vec<OsString> {
        ["cat-file", "-t", &format!("{}^{{}}", self.reference())].map(OsString::from).to_vec()
    }

    /// Where the world lies in the repository.
    #[must_use]
    pub fn world_path(&self, world: &ProjectUrl) -> String {
        let slash = if self.folder.is_empty() { "" } else { "/" };
        format!("{}{slash}worlds/{}", self.folder, world.world())
    }
}

/// The files of a project as the commit has them.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Listing {
    /// Of all files, in bytes.
    pub size: u64,
    /// How many files there are, and folders.
    pub entries: u64,
    /// Whether the world is among them.
    pub has_world: bool,
    /// Whether a folder on the way to the world is a link.
    pub has_link: bool,
}

impl Listing {
    /// Reads the answer of `git ls-tree -r -l -z`.
    #[must_use]
    pub fn parse(answer: &[u8], world_path: &str) -> Self {
        let mut listing = Self::default();
        let mut last_path: &[u8] = b"";
        for entry in answer.split(|byte| *byte == 0) {
            let Some(tab) = entry.iter().position(|byte| *byte == b'\t') else {
                continue;
            };
            let (about, path) = entry.split_at(tab);
            let path = path.get(1..).unwrap_or_default();
            let size = about.rsplit(|byte| *byte == b' ').next().and_then(|size| str::from_utf8(size).ok());
            listing.size = listing.size.saturating_add(size.and_then(|size| size.parse().ok()).unwrap_or(0));
            listing.entries += 1 + new_folders(last_path, path);
            listing.has_world |= path == world_path.as_bytes();
            let rest = world_path.as_bytes().strip_prefix(path);
            listing.has_link |= about.starts_with(b"120000 ") && rest.is_some_and(|rest| rest.starts_with(b"/"));
            last_path = path;
        }
        listing
    }
}

/// How many folders of a path are not in the one before it; git lists what is in a folder together.
fn new_folders(before: &[u8], path: &[u8]) -> u64 {
    let common = before.iter().zip(path).take_while(|(one, other)| one == other).count();
    let rest = path.get(common..).unwrap_or_default();
    rest.iter().fold(0, |count, byte| count + u64::from(*byte == b'/'))
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
    fn a_branch_with_slashes_is_found_and_preferred_to_a_shorter_tag() {
        let url = world("blob/feature/arm/lab/worlds/a.wbt");
        let answer =
            format!("{A}\trefs/tags/feature\n{B}\trefs/heads/feature/arm\n{B}\trefs/heads/x/refs/heads/feature\n");
        let found: Vec<_> = found(&url, &answer).into_iter().map(|one| (one.commit, one.name, one.folder)).collect();
        let expected = [(B, "feature/arm", "lab"), (A, "feature", "arm/lab")];
        assert_eq!(
            found,
            expected.map(|(commit, name, folder)| (commit.to_owned(), name.to_owned(), folder.to_owned()))
        );
    }

    #[test]
    fn a_full_hash_is_a_commit() {
        let commit = commit_of(&world(&format!("tree/{A}/p/worlds/a.wbt")), false).unwrap();
        assert!(commit.is_commit());
        assert_eq!(commit.world_path(&world("blob/x/worlds/a.wbt")), "p/worlds/a.wbt");
        assert_eq!(commit_of(&world("blob/aaaaaaa/worlds/a.wbt"), false), None, "short hashes are not unique");
        assert_eq!(
            commit_of(&world(&format!("src/branch/{A}/worlds/a.wbt")), false),
            None,
            "it says that it is a branch"
        );
    }

    #[test]
    fn only_branches_and_tags_vouch_for_a_commit() {
        let answer = format!("{A}\trefs/pull/1/head\n{B}\trefs/tags/v1^{{}}\n");
        assert!(is_tip(&answer, B) && !is_tip(&answer, A));
    }

    #[test]
    fn a_hash_of_another_length_is_of_no_commit() {
        let answer = format!("{A}\trefs/heads/main\n");
        assert!(is_of_other_length(&answer, &"a".repeat(64)) && !is_of_other_length(&answer, B));
        assert!(!is_of_other_length("", B), "nothing is known of an empty repository");
    }

    #[test]
    fn an_answer_that_is_no_hash_is_never_used() {
        let url = world("blob/main/worlds/a.wbt");
        assert_eq!(found(&url, "--upload-pack=evil\trefs/heads/main\n"), []);
        assert_eq!(found(&url, "nonsense"), []);
    }

    #[test]
    fn a_listing_knows_sizes_and_paths() {
        let answer = b"100644 blob aaa      12\tp/worlds/a b.wbt\x00120000 blob bbb       3\tp/link\x00160000 commit ccc -\tp/module\x00";
        let listing = Listing::parse(answer, "p/worlds/a b.wbt");
        assert_eq!(listing, Listing { size: 15, entries: 5, has_world: true, has_link: false });
        assert!(!Listing::parse(answer, "worlds/a b.wbt").has_world);
        assert!(Listing::parse(answer, "p/link/worlds/a.wbt").has_link);
        for other in ["p/link", "p/linked/a.wbt", "p/module/a.wbt"] {
            assert!(!Listing::parse(answer, other).has_link, "{other}");
        }
    }
}
