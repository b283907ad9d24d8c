//! Checks that the packet filter is loaded, which keeps containers off this machine and private addresses:
//! `deploy/nftables/containers.nft`.

use std::path::Path;
use std::time::Duration;

use crate::simulation::process::{ExitReason, Ran, Run};

/// Lists the table of the filter.
const LIST: &[&str] = &["/usr/sbin/nft", "--terse", "list", "table", "inet", "webots_fleet"];
/// Asks for the unit that loads it.
const UNIT: &[&str] = &["systemctl", "is-active", "--quiet", "webots-fleet-packet-filter.service"];
/// Timeout of the `nft` or `systemctl` call.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Returns `None` if the packet filter is loaded, else the consequence and how to load it, in one line. Only root may
/// list it; for other users systemd reports whether its unit has run.
///
/// Blocks for five seconds at most, because it runs a program.
#[must_use]
pub fn missing() -> Option<String> {
    let command = if nix::unistd::geteuid().is_root() { LIST } else { UNIT };
    let why = match Run::new(command, Path::new("/"), TIMEOUT).blocking(drop) {
        Ok(Ran { ending: ExitReason::Code(0), .. }) => return None,
        Ok(_) => "says no".to_owned(),
        Err(error) => error.to_string(),
    };
    Some(format!(
        "containers may reach this machine and private addresses, for the packet filter is not loaded ('{}' {why}): \
         install nftables and run 'systemctl enable --now webots-fleet-packet-filter'",
        command.join(" ")
    ))
}
