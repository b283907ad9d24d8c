//! What lies in a commit: the reading of `git ls-tree`. Pure.

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

impl Listing {
    /// Adds files that `git ls-tree -l -z` lists beside folders. Returns their paths, each ended by a zero byte.
    pub fn add_files(&mut self, answer: &[u8]) -> Vec<u8> {
        let is_file = |entry: &&[u8]| entry.starts_with(b"100") || entry.starts_with(b"120");
        let mut paths = Vec::new();
        for entry in answer.split(|byte| *byte == 0).filter(is_file) {
            let listing = Self::parse(entry, "");
            self.size = self.size.saturating_add(listing.size);
            self.entries += 1;
            let path = entry.splitn(2, |byte| *byte == b'\t').nth(1).unwrap_or_default();
            paths.extend(path.iter().chain(&[0]));
        }
        paths
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
