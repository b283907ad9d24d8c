//! The limit of open files. Shells give 1,024, and the system mostly allows many more.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// The limit that is assumed where the system does not say.
const USUAL: u64 = 1024;

/// Raises the limit of open files to `wanted`, or as near to it as the system allows. A limit that is higher already stays.
/// Returns the limit.
pub fn raise_open_files(wanted: u64) -> u64 {
    let limits = getrlimit(Resource::RLIMIT_NOFILE);
    let raised = limits.and_then(|(now, most)| {
        let limit = now.max(wanted.min(most));
        setrlimit(Resource::RLIMIT_NOFILE, limit, most).map(|()| limit)
    });
    raised.unwrap_or_else(|error| {
        log::warn!("the limit of open files can't be raised: {error}");
        limits.map_or(USUAL, |(now, _)| now)
    })
}
