//! Checks that the packet filter is loaded, which keeps containers off this machine and private addresses:
//! `deploy/nftables/containers.nft`.

use std::path::Path;
use std::time::Duration;

use crate::simulation::process::{ExitReason, Ran, Run, RunError};

/// The table of the filter.
const TABLE: &str = "webots_fleet";
/// The table that keeps others from the streams that this server relays.
const STREAMS: &str = "webots_streams";
/// The unit that loads it.
const UNIT: [&str; 3] = ["is-active", "--quiet", "webots-fleet-packet-filter.service"];
/// Timeout of the `nft` or `systemctl` call.
const PATIENCE: Duration = Duration::from_secs(5);

/// Returns `None` if the packet filter is loaded, else the consequence and how to load it, in one line. Only root may
/// list it; for other users systemd reports whether its unit has run.
///
/// Blocks for five seconds at most, because it runs a program.
#[must_use]
pub fn missing() -> Option<String> {
    let is_root = nix::unistd::geteuid().is_root();
    let result = if is_root { list(TABLE) } else { succeeds("systemctl", &UNIT, PATIENCE) };
    let why = result.err()?;
    Some(format!(
        "containers may reach this machine and private addresses, for the packet filter is not loaded ({why}): install \
         nftables and run 'systemctl enable --now webots-fleet-packet-filter'"
    ))
}

/// Whether a packet filter keeps others from the ports of Webots; unknown to users other than root.
///
/// Blocks for five seconds at most, because it runs a program.
#[must_use]
pub fn closes_streams() -> Option<bool> {
    nix::unistd::geteuid().is_root().then(|| list(STREAMS).is_ok())
}

/// Lists a table of the filter, which only root may.
fn list(table: &str) -> Result<(), String> {
    succeeds("/usr/sbin/nft", &["--terse", "list", "table", "inet", table], PATIENCE)
}

/// Whether a program exits with code 0, or why not.
fn succeeds(program: &str, arguments: &[&str], patience: Duration) -> Result<(), String> {
    let name = || format!("'{program} {}'", arguments.join(" "));
    let command = std::iter::once(program).chain(arguments.iter().copied());
    match Run::new(command, Path::new("/"), patience).blocking(drop) {
        Ok(Ran { ending: ExitReason::Code(0), .. }) => Ok(()),
        Ok(_) => Err(format!("{} says no", name())),
        Err(error @ RunError::NotStarted(_)) => Err(format!("{program} {error}")),
        Err(_) => Err(format!("{} does not answer", name())),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn a_filter_is_there_only_if_the_program_says_so() {
        assert_eq!(succeeds("true", &[], PATIENCE), Ok(()));
        assert_eq!(succeeds("false", &["x"], PATIENCE), Err("'false x' says no".to_owned()));
        assert!(succeeds("/nowhere/nft", &[], PATIENCE).unwrap_err().contains("No such file"));
    }

    #[test]
    fn a_program_that_hangs_is_ended() {
        let (began, patience) = (Instant::now(), Duration::from_millis(50));
        assert_eq!(succeeds("sleep", &["1000"], patience), Err("'sleep 1000' does not answer".to_owned()));
        assert!(began.elapsed() >= patience, "{:?}", began.elapsed());
    }
}
