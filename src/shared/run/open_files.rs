//! The limit of open files. The default is often 1,024, and the hard limit is mostly much higher.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// The limit that is assumed if the system does not report it.
const USUAL: u64 = 1024;

/// Raises the limit of open files to `wanted`, or as close as the system allows. A higher limit stays. Returns the
/// limit.
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
