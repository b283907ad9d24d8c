//! The URL of a world in a git repository, as a web client types it. Where a repository is fetched from is in the
//! simulation server's `config/mirrors`.

use std::fmt;
use std::path::Path;

use percent_encoding::percent_decode_str;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use url::Url;

/// A world: a repository on a Git host, and the path of a world file below a reference of it.
///
/// The reference may contain slashes (`feature/arm`), so the URL alone does not show where it ends;
/// [`ProjectUrl::candidates`] returns the possible readings, and the repository's branches and tags decide.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct ProjectUrl {
    host: String,
    /// The path segments that name the repository, percent-decoded, as are the other segments.
    repository: Vec<String>,
    /// The segments that the Git host inserts before the reference, such as `blob`.
    marker: Vec<String>,
    /// Reference, the project's directory, `worlds` and the world file.
    inside: Vec<String>,
}

/// One way to read a world's URL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reading {
    /// Branch, tag or commit.
    pub reference: String,
    /// The project's directory inside the repository; empty for its root.
    pub folder: String,
}

/// Why a text is not the URL of a world: the problem, without initial capital and period. The message is for the web
/// client.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "Wrong Webots simulation URL: {0}. Allowed is https://github.com/USER/REPOSITORY/blob/REFERENCE/PATH/worlds/NAME.wbt."
)]
pub struct ProjectUrlError(pub String);

fn url_error(problem: impl Into<String>) -> ProjectUrlError {
    ProjectUrlError(problem.into())
}

/// Longest URL that is parsed, in bytes.
const MAX_LENGTH: usize = 2000;

impl ProjectUrl {
    /// Reads a world's URL in the form of GitHub, GitLab (`/-/blob/`) or Gitea (`/src/branch/`).
    ///
    /// # Errors
    /// When it is not `https`, names a user, holds encoded slashes or control characters, or does not end in
    /// `/worlds/NAME.wbt`. A query and a fragment, as pages of Git hosts add them, are ignored.
    pub fn parse(text: &str) -> Result<Self, ProjectUrlError> {
        let (host, mut segments) = split_url(text)?;
        let (repository, reference) = split_repository(&segments)?;
        let inside = segments.split_off(reference);
        let marker = segments.split_off(repository);
        let world = match inside.as_slice() {
            [.., folder, world] if folder == "worlds" => world,
            _ => return Err(url_error("missing worlds folder: it does not end in /worlds/NAME.wbt")),
        };
        if !Path::new(world)
            .extension()
            .is_some_and(|extension| extension.eq_ignore_ascii_case("wbt"))
        {
            return Err(url_error(format!("missing world file: {world:?} is no world file")));
        }
        if inside.len() < 3 {
            return Err(url_error("it names no branch or tag"));
        }
        if inside.iter().any(|segment| segment.eq_ignore_ascii_case(".git")) {
            return Err(url_error("a folder is called .git"));
        }
        Ok(Self {
            host,
            repository: plain_repository(segments)?,
            marker,
            inside,
        })
    }

    /// Returns the same world in the repository at this URL.
    ///
    /// # Errors
    /// When that is not the URL of a repository.
    pub fn in_repository(&self, url: &str) -> Result<Self, ProjectUrlError> {
        let (host, segments) = split_url(url)?;
        Ok(Self {
            host,
            repository: plain_repository(segments)?,
            ..self.clone()
        })
    }

    /// The Git host, in lower case, with its port if that is not 443.
    pub fn host(&self) -> &str {
        &self.host
    }

    /// All path segments of the URL, percent-decoded.
    pub fn segments(&self) -> impl Iterator<Item = &String> {
        [&self.repository, &self.marker, &self.inside].into_iter().flatten()
    }

    /// The path segments that name the repository, such as user and name.
    pub fn repository_segments(&self) -> &[String] {
        &self.repository
    }

    /// The repository's URL, such as `https://github.com/lab/arm`.
    pub fn repository(&self) -> String {
        format!("https://{}/{}", self.host, self.repository.join("/"))
    }

    /// The world file's name, such as `arena.wbt`.
    pub fn world(&self) -> &str {
        self.inside.last().map_or("", String::as_str)
    }

    /// The possible readings, sorted by the length of the reference, shortest first.
    pub fn candidates(&self) -> Vec<Reading> {
        let before_worlds = self.inside.len().saturating_sub(2);
        // Longer references are not expected: each reading costs names in the query of the remote.
        (1..=before_worlds.min(12))
            .filter_map(|length| {
                let (reference, folder) = self.inside.get(..before_worlds)?.split_at_checked(length)?;
                Some(Reading {
                    reference: reference.join("/"),
                    folder: folder.join("/"),
                })
            })
            .collect()
    }
}

impl TryFrom<String> for ProjectUrl {
    type Error = ProjectUrlError;

    fn try_from(text: String) -> Result<Self, ProjectUrlError> {
        Self::parse(&text)
    }
}

impl From<ProjectUrl> for String {
    fn from(world: ProjectUrl) -> Self {
        world.to_string()
    }
}

impl fmt::Display for ProjectUrl {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            out,
            "{}/{}/{}",
            self.repository(),
            self.marker.join("/"),
            self.inside.join("/")
        )
    }
}

/// Removes the `.git` that git may append to the name of a repository: both names mean the same repository.
pub(super) fn plain_repository(mut segments: Vec<String>) -> Result<Vec<String>, ProjectUrlError> {
    let name = segments.last_mut().ok_or_else(|| url_error("it names no repository"))?;
    while name.to_ascii_lowercase().ends_with(".git") {
        name.truncate(name.len() - 4);
    }
    if name.is_empty() {
        Err(url_error("it names no repository"))
    } else {
        Ok(segments)
    }
}

/// Splits an `https` URL into its host and its percent-decoded path segments, by the URL Standard, and refuses
/// anything that git or the file system could resolve differently.
///
/// # Errors
/// See [`ProjectUrl::parse`].
pub(super) fn split_url(text: &str) -> Result<(String, Vec<String>), ProjectUrlError> {
    if text.len() > MAX_LENGTH {
        return Err(url_error(format!("it is longer than {MAX_LENGTH} bytes")));
    }
    let url = Url::parse(text).map_err(|error| url_error(format!("it is no URL ({error})")))?;
    if url.scheme() != "https" {
        return Err(url_error("it does not begin with https://"));
    }
    if !url.username().is_empty() || url.password().is_some() {
        return Err(url_error("it names a user"));
    }
    let host = url
        .host_str()
        .filter(|host| !host.starts_with('-'))
        .ok_or_else(|| url_error("it names no host"))?;
    let host = if host == "www.github.com" { "github.com" } else { host };
    let host = url
        .port()
        .map_or_else(|| host.to_owned(), |port| format!("{host}:{port}"));
    let segments = url.path().split('/').filter(|raw| !raw.is_empty()).map(decode_segment);
    Ok((host, segments.collect::<Result<_, _>>()?))
}

fn decode_segment(raw: &str) -> Result<String, ProjectUrlError> {
    let segment = percent_decode_str(raw)
        .decode_utf8()
        .map_err(|_| url_error(format!("{raw:?} is no UTF-8 text")))?;
    if segment
        .chars()
        .any(|letter| letter.is_control() || letter == '/' || letter == '\\')
    {
        return Err(url_error(format!(
            "{raw:?} holds an encoded slash or control character"
        )));
    }
    Ok(segment.into_owned())
}

/// Finds the end of the repository and the start of the reference.
pub(super) fn split_repository(segments: &[String]) -> Result<(usize, usize), ProjectUrlError> {
    let words: Vec<&str> = segments.iter().map(String::as_str).collect();
    if let Some(dash) = words.iter().position(|word| *word == "-")
        && dash >= 2
        && matches!(words.get(dash + 1), Some(&("blob" | "tree")))
    {
        return Ok((dash, dash + 2));
    }
    match words.as_slice() {
        [_, _, "blob" | "tree", ..] => Ok((2, 3)),
        [_, _, "src", "branch" | "tag" | "commit", ..] => Ok((2, 4)),
        [_, _, other, ..] => Err(url_error(format!(
            "missing blob or tree after the repository, where {other:?} stands"
        ))),
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
            "https://github.com/u/.git/blob/main/worlds/a.wbt",
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
            "https://github.com/u/r/blob/ma%00in/worlds/a.wbt",
            "https:///u/r/blob/main/worlds/a.wbt",
            "https://--upload-pack=id/u/r/blob/main/worlds/a.wbt",
        ] {
            assert!(ProjectUrl::parse(text).is_err(), "{text:?} was taken for a world");
        }
    }
}
