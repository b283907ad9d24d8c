//! The configured limits that this machine can't enforce, as text for an administrator.

use super::cgroup::Controllers;
use crate::simulation::config::ResourceLimits;

/// The means of enforcement on this machine.
#[derive(Debug)]
pub struct Enforcement {
    /// Whether `prlimit` is installed, which sets the kernel's limits.
    pub has_prlimit: bool,
    /// Whether programs in sandboxes can create user namespaces.
    pub leaves_namespaces: bool,
    /// The controllers of control groups.
    pub controllers: Controllers,
}

/// The limits that can't be enforced, one line each.
pub fn unenforced_limits(means: &Enforcement, limits: &ResourceLimits) -> Vec<String> {
    let mut lines = Vec::new();
    if !means.has_prlimit {
        lines.push(
            "limits.openFiles does not hold, and files, core dumps and processes have no limit of the kernel's: prlimit is \
             not there; on Debian, Ubuntu and Fedora the package util-linux has it"
                .to_owned(),
        );
    }
    if means.leaves_namespaces {
        lines.push(
            "worlds' programs can make user namespaces, which brings more of the kernel within their reach: only \
             bubblewrap from 0.8 on forbids it"
                .to_owned(),
        );
    }
    let wanted =
        [("limits.memory", "memory", limits.memory.is_some()), ("limits.cores", "cpu", limits.cores.is_some())];
    for (key, controller, is_set) in wanted {
        if is_set && !means.controllers.contains(&controller) {
            lines.push(format!(
                "{key} does not hold: systemd has not delegated control groups with the controller {controller} to this \
                 program (Delegate={controller} in its unit)"
            ));
        }
    }
    lines
}
