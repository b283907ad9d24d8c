//! The limit of open files. The default is often 1,024, and the hard limit is mostly much higher.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Raises the limit of open files to `wanted`, or as close as the system allows. A higher limit stays. Returns the
/// limit.
pub fn raise_open_files(wanted: u64) -> u64 {
    let Ok((now, most)) = getrlimit(Resource::RLIMIT_NOFILE) else {
        return 1024;
    };
    let limit = now.max(wanted.min(most));
    setrlimit(Resource::RLIMIT_NOFILE, limit, most).map_or(now, |()| limit)
}

/// Returns the limit of clients: `max_clients`, or `possible` if the limit of open `files` allows no more.
///
/// # Errors
/// When `possible` is 0; `needed` names the minimum in the message.
pub fn limit_clients(files: u64, possible: usize, max_clients: usize, needed: &str) -> Result<usize, String> {
    if possible == 0 {
        return Err(format!(
            "{files} files may be open, which is not enough for {needed}; ulimit -Hn, or LimitNOFILE of systemd, \
             allows more"
        ));
    }
    if possible < max_clients {
        log::warn!(
            "{files} files may be open, which is enough for {possible} clients, not for maxClients ({max_clients}); \
             ulimit -Hn, or LimitNOFILE of systemd, allows more"
        );
    }
    Ok(possible.min(max_clients))
}
