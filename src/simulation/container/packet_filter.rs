//! Checks that the packet filter is loaded, which keeps containers from this machine and private addresses:
//! `deploy/nftables/containers.nft`.

use std::path::Path;
use std::time::Duration;

use crate::simulation::process::{ExitReason, Ran, Run};

/// The table of the filter.
const TABLE: &str = "webots_fleet";
/// The table that keeps others from the streams that this server relays.
const STREAMS: &str = "webots_streams";
/// Checks the unit that loads it.
const UNIT: &[&str] = &[
    "systemctl",
    "is-active",
    "--quiet",
    "webots-fleet-packet-filter.service",
];
/// Timeout of the `nft` or `systemctl` call.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Returns `None` if the packet filter is loaded, else the consequence and how to load it, in one line. Only root may
/// list it; for other users systemd reports whether its unit has run.
///
/// Blocks for five seconds at most, because it runs a program.
pub fn missing() -> Option<String> {
    let is_root = nix::unistd::geteuid().is_root();
    let why = if is_root { list(TABLE) } else { succeeds(UNIT) }.err()?;
    Some(format!(
        "containers may reach this machine and private addresses, for the packet filter is not loaded ({why}): install \
         nftables and run 'systemctl enable --now webots-fleet-packet-filter'"
    ))
}

/// Whether a packet filter keeps others from the ports of Webots; unknown to users other than root.
///
/// Blocks for five seconds at most, because it runs a program.
pub fn closes_streams() -> Option<bool> {
    nix::unistd::geteuid().is_root().then(|| list(STREAMS).is_ok())
}

/// Lists a table of the filter, which only root may.
fn list(table: &str) -> Result<(), String> {
    succeeds(&["/usr/sbin/nft", "--terse", "list", "table", "inet", table])
}

/// Whether a program exits with code 0, or why not.
fn succeeds(command: &[&str]) -> Result<(), String> {
    let why = match Run::new(command, Path::new("/"), TIMEOUT).run_blocking(drop) {
        Ok(Ran {
            ending: ExitReason::Code(0),
            ..
        }) => return Ok(()),
        Ok(_) => "says no".to_owned(),
        Err(error) => error.to_string(),
    };
    Err(format!("'{}' {why}", command.join(" ")))
}
