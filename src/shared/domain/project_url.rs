//! The URL of a world in a git repository, as a web client types it.

use std::fmt;
use std::path::Path;

use percent_encoding::percent_decode_str;

/// A world: a repository on a Git host, and the path of a world file below a reference of it.
///
/// The reference may contain slashes (`feature/arm`), so the URL alone does not show where it ends;
/// [`ProjectUrl::candidates`] returns the possible readings, and the repository decides.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct ProjectUrl {
    host: String,
    /// Every path segment, percent-decoded.
    segments: Vec<String>,
    /// Number of segments that name the repository.
    repository: usize,
    /// Number of segments before the reference.
    reference: usize,
    /// The kind of reference that the URL names; GitHub and GitLab don't name it.
    kind: RefKind,
}

/// The kind of reference that a URL names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RefKind {
    /// A branch, a tag or a commit.
    Any,
    /// A branch (Gitea: `src/branch/NAME`).
    Branch,
    /// A tag (Gitea: `src/tag/NAME`).
    Tag,
    /// A commit (Gitea: `src/commit/HASH`).
    Commit,
}

/// One way to read a world's URL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reading {
    /// Branch, tag or commit.
    pub reference: String,
    /// The project's directory inside the repository; empty for its root.
    pub folder: String,
}

/// Why a text is not the URL of a world. The message is for the web client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "Wrong Webots simulation URL: {problem}. Allowed is https://github.com/USER/REPOSITORY/blob/REFERENCE/PATH/worlds/NAME.wbt."
)]
pub struct ProjectUrlError {
    /// The problem, without a capital letter and a period.
    pub problem: String,
}

fn url_error(problem: impl Into<String>) -> ProjectUrlError {
    ProjectUrlError { problem: problem.into() }
}

/// Longest URL that is parsed, in bytes.
const MAX_LENGTH: usize = 2000;

impl ProjectUrl {
    /// Reads a world's URL in the form of GitHub, GitLab (`/-/blob/`) or Gitea (`/src/branch/`).
    ///
    /// # Errors
    /// When it is not `https`, names a user, holds `.` or `..` as segments, encoded slashes or control characters, or does
    /// not end in `/worlds/NAME.wbt`. A query and a fragment, as pages of Git hosts add them, are ignored.
    pub fn parse(text: &str) -> Result<Self, ProjectUrlError> {
        if text.len() > MAX_LENGTH {
            return Err(url_error(format!("it is longer than {MAX_LENGTH} bytes")));
        }
        let (host, mut segments) = split_url(text.split(['?', '#']).next().unwrap_or_default())?;
        let (repository, reference, kind) = split_repository(&segments)?;
        if let Some(name) = repository.checked_sub(1).and_then(|last| segments.get_mut(last)) {
            *name = without_git(name)?;
        }
        let inside = segments.get(reference..).unwrap_or_default();
        let world = match inside {
            [.., folder, world] if folder == "worlds" => world,
            _ => return Err(url_error("missing worlds folder: it does not end in /worlds/NAME.wbt")),
        };
        if !Path::new(world).extension().is_some_and(|extension| extension.eq_ignore_ascii_case("wbt")) {
            return Err(url_error(format!("missing world file: {world:?} is no world file")));
        }
        if inside.len() < 3 {
            return Err(url_error("it names no branch or tag"));
        }
        if inside.iter().any(|segment| segment.eq_ignore_ascii_case(".git")) {
            return Err(url_error("a folder is called .git"));
        }
        Ok(Self { host, segments, repository, reference, kind })
    }

    /// Returns the same world in the repository at this URL.
    ///
    /// # Errors
    /// When that is not the URL of a repository.
    pub fn in_repository(&self, url: &str) -> Result<Self, ProjectUrlError> {
        let (host, mut segments) = split_url(url)?;
        let name = segments.last_mut().ok_or_else(|| url_error("it names no repository"))?;
        *name = without_git(name)?;
        let repository = segments.len();
        let reference = repository + self.reference.saturating_sub(self.repository);
        segments.extend(self.segments.iter().skip(self.repository).cloned());
        Ok(Self { host, segments, repository, reference, kind: self.kind })
    }

    /// The Git host, in lower case, with its port if that is not 443.
    pub fn host(&self) -> &str {
        &self.host
    }

    /// All path segments of the URL, percent-decoded.
    pub fn segments(&self) -> &[String] {
        &self.segments
    }

    /// The path segments that name the repository, such as user and name.
    pub fn repository_segments(&self) -> &[String] {
        self.segments.get(..self.repository).unwrap_or_default()
    }

    /// The repository's URL, such as `https://github.com/lab/arm`.
    pub fn repository(&self) -> String {
        format!("https://{}/{}", self.host, self.repository_segments().join("/"))
    }

    /// The kind of reference that the URL names.
    pub fn kind(&self) -> RefKind {
        self.kind
    }

    /// The world file's name, such as `arena.wbt`.
    pub fn world(&self) -> &str {
        self.segments.last().map_or("", String::as_str)
    }

    /// The possible readings, sorted by the length of the reference, shortest first.
    pub fn candidates(&self) -> Vec<Reading> {
        // Reference, directory and world, without the segments that a Git host inserts before them.
        let inside = self.segments.get(self.reference..).unwrap_or_default();
        let before_worlds = inside.len().saturating_sub(2);
        // No branch has more slashes.
        (1..=before_worlds.min(12))
            .filter_map(|length| {
                let reference = inside.get(..length)?.join("/");
                let folder = inside.get(length..before_worlds)?.join("/");
                Some(Reading { reference, folder })
            })
            .collect()
    }
}

impl fmt::Display for ProjectUrl {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "https://{}/{}", self.host, self.segments.join("/"))
    }
}

/// A repository's name without the `.git` that git may append: both name the same repository.
pub(super) fn without_git(name: &str) -> Result<String, ProjectUrlError> {
    let split = name.len().checked_sub(4).and_then(|end| name.split_at_checked(end));
    let plain = split.filter(|(_, end)| end.eq_ignore_ascii_case(".git")).map_or(name, |(plain, _)| plain);
    if plain.is_empty() {
        return Err(url_error("it names no repository"));
    }
    // git would find the same repository under this name, but a block of the repository would not match it.
    if plain.len() < name.len() && plain.to_ascii_lowercase().ends_with(".git") {
        return Err(url_error(format!("the repository's name {name:?} ends in .git more than once")));
    }
    Ok(plain.to_owned())
}

/// Splits an `https` URL into its host and its percent-decoded path segments, and refuses anything that git or the file
/// system could resolve differently.
///
/// # Errors
/// See [`ProjectUrl::parse`].
pub(super) fn split_url(text: &str) -> Result<(String, Vec<String>), ProjectUrlError> {
    if text.len() > MAX_LENGTH {
        return Err(url_error(format!("it is longer than {MAX_LENGTH} bytes")));
    }
    if text.chars().any(|letter| letter.is_control() || letter == '\\') {
        return Err(url_error("it holds a backslash or a control character"));
    }
    let Some(rest) = text.get(..8).filter(|scheme| scheme.eq_ignore_ascii_case("https://")).and_then(|_| text.get(8..))
    else {
        return Err(url_error("it does not begin with https://"));
    };
    let (authority, path) = rest.split_once('/').unwrap_or((rest, ""));
    if path.contains(['?', '#']) {
        return Err(url_error("it holds ? or #"));
    }
    let host = parse_host(authority)?;
    if path.is_empty() {
        return Ok((host, Vec::new()));
    }
    let segments = path.split('/').filter(|raw| !raw.is_empty()).map(decode_segment).collect::<Result<_, _>>()?;
    Ok((host, segments))
}

fn parse_host(authority: &str) -> Result<String, ProjectUrlError> {
    if authority.contains('@') {
        return Err(url_error("it names a user"));
    }
    let parsed = url::Url::parse(&format!("https://{authority}/"))
        .map_err(|error| url_error(format!("its host {authority:?} can't be read ({error})")))?;
    let host = parsed.host_str().unwrap_or_default();
    let is_label = |label: &str| {
        let mut letters = label.chars();
        !label.starts_with('-') && letters.all(|letter| letter.is_ascii_alphanumeric() || "-_".contains(letter))
    };
    if matches!(parsed.host(), Some(url::Host::Domain(name)) if !name.split('.').all(is_label)) {
        return Err(url_error(format!("its host {authority:?} is not the name of a host")));
    }
    let host = if host == "www.github.com" { "github.com" } else { host }.to_owned();
    Ok(parsed.port().map_or(host.clone(), |port| format!("{host}:{port}")))
}

fn decode_segment(raw: &str) -> Result<String, ProjectUrlError> {
    let segment =
        percent_decode_str(raw).decode_utf8().map_err(|_| url_error(format!("{raw:?} is no UTF-8 text")))?.into_owned();
    if segment.is_empty() || segment == "." || segment == ".." {
        return Err(url_error("its path holds an empty segment, . or .."));
    }
    if segment.chars().any(|letter| letter.is_control() || letter == '/' || letter == '\\') {
        return Err(url_error(format!("{raw:?} holds an encoded slash or control character")));
    }
    Ok(segment)
}

/// Finds the end of the repository and the begin of the reference.
pub(super) fn split_repository(segments: &[String]) -> Result<(usize, usize, RefKind), ProjectUrlError> {
    let words: Vec<&str> = segments.iter().map(String::as_str).collect();
    if let Some(dash) = words.iter().position(|word| *word == "-")
        && dash >= 2
        && matches!(words.get(dash + 1), Some(&("blob" | "tree")))
    {
        return Ok((dash, dash + 2, RefKind::Any));
    }
    match words.as_slice() {
        [_, _, "blob" | "tree", ..] => Ok((2, 3, RefKind::Any)),
        [_, _, "src", "branch", ..] => Ok((2, 4, RefKind::Branch)),
        [_, _, "src", "tag", ..] => Ok((2, 4, RefKind::Tag)),
        [_, _, "src", "commit", ..] => Ok((2, 4, RefKind::Commit)),
        [_, _, other, ..] => {
            Err(url_error(format!("missing blob or tree after the repository, where {other:?} stands")))
        }
        _ => Err(url_error("it names no repository")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tricks_are_refused() {
        for text in [
            "",
            "http://github.com/u/r/blob/main/worlds/a.wbt",
            "file:///etc/passwd",
            "ext::sh -c id",
            "https://github.com/u/r",
            "https://github.com/u/r/blob/worlds/a.wbt",
            "https://github.com/u/r/blob/main/a.wbt",
            "https://github.com/u/r.git.git/blob/main/worlds/a.wbt",
            "https://github.com/u/r.GIT%2egit/blob/main/worlds/a.wbt",
            "https://github.com/u/r/blob/main/worlds/.wbt",
            "https://github.com/u/r/blob/main/worlds/a.txt",
            "https://github.com/u/r/wiki/main/worlds/a.wbt",
            "https://github.com/u/r/blob/../worlds/a.wbt",
            "https://github.com/u/r/blob/%2e%2e/worlds/a.wbt",
            "https://github.com/u/r/blob/main/p%2f..%2fq/worlds/a.wbt",
            "https://github.com/u/r/blob/main/p%5cq/worlds/a.wbt",
            "https://github.com/u/r/blob/main/.git/worlds/a.wbt",
            "https://me@github.com/u/r/blob/main/worlds/a.wbt",
            "https://github.com@evil.org/u/r/blob/main/worlds/a.wbt",
            "https://github.com\\@evil.org/u/r/blob/main/worlds/a.wbt",
            "https://github.com/u/r/blob/main/worlds/a?x=.wbt",
            "https://github.com/u/r/blob/main/worlds/a#/worlds/b.wbt",
            "https://github.com?@evil.org/u/r/blob/main/worlds/a.wbt",
            "https://github.com/u/r/blob/ma\nin/worlds/a.wbt",
            "https://github.com/u/r/blob/ma%00in/worlds/a.wbt",
            "https:///u/r/blob/main/worlds/a.wbt",
            "https://--upload-pack=id/u/r/blob/main/worlds/a.wbt",
            "https://a.-b.org/u/r/blob/main/worlds/a.wbt",
        ] {
            assert!(ProjectUrl::parse(text).is_err(), "{text:?} was taken for a world");
        }
    }
}
