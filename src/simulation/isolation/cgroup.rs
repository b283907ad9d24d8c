//! A control group (cgroup v2) for each simulation, if systemd delegates them to this server (`Delegate=yes`).
//!
//! They limit memory, CPU time and processes, and all processes in a group end with it, even if they detach. A server
//! that was started in a terminal gets none: it shares its group with other processes, which it must not move.

use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use procfs::process::Process;

use crate::simulation::config::ResourceLimits;
use crate::simulation::ends::ResourceUsage;
use crate::simulation::process::Cause;

/// The control groups below this server's own.
pub struct Cgroups(PathBuf);

/// The control group of one simulation: its directory. Dropping it kills all processes inside, and removes it.
pub struct Cgroup(pub PathBuf);

/// The group of the server itself: cgroup v2 allows no processes in a group that enables controllers for subgroups.
const OWN: &str = "server";
/// The controllers that are used.
const CONTROLLERS: [&str; 3] = ["cpu", "memory", "pids"];
/// The kernel's period of CPU limits, in microseconds.
const PERIOD: u64 = 100_000;
/// Maximum number of processes that run a simulation and do not count towards its limit: bubblewrap has one outside the
/// sandbox and one inside, and pasta is one.
const RUNNERS: u64 = 3;
/// Time for killed processes to exit.
const VANISH: Duration = Duration::from_secs(2);
/// Interval between two checks whether they have exited.
const PAUSE: Duration = Duration::from_millis(5);

impl Cgroups {
    /// The control groups that are delegated to this server, if any. No process may have been started before: one that
    /// is just exiting would be taken for another owner of the server's group.
    pub fn delegated() -> Option<Self> {
        let folder = own_folder()?;
        let divided = Self::divide(&folder).inspect_err(|error| {
            log::info!(
                "simulations get no control groups: {} can't be divided: {error}",
                folder.display()
            );
        });
        divided.ok()?;
        log::info!("each simulation gets a control group below {}", folder.display());
        Some(Self(folder))
    }

    /// Moves this server into a subgroup, so that there can be others beside it.
    fn divide(folder: &Path) -> io::Result<()> {
        let own = folder.join(OWN);
        std::fs::create_dir_all(&own)?;
        std::fs::write(own.join("cgroup.procs"), std::process::id().to_string())?;
        for controller in offered(folder)? {
            std::fs::write(folder.join("cgroup.subtree_control"), format!("+{controller}"))?;
        }
        Ok(())
    }

    /// The kernel's names of the controllers that simulations' groups would have if the server started now.
    pub fn controllers() -> Vec<&'static str> {
        own_folder()
            .and_then(|folder| offered(&folder).ok())
            .unwrap_or_default()
    }

    /// Creates a group with these limits for a simulation; `None` if that fails: the simulation then runs without one.
    pub fn make(&self, limits: &ResourceLimits) -> Option<Cgroup> {
        let made = tempfile::Builder::new().prefix("simulation-").tempdir_in(&self.0);
        let made = made.inspect_err(|error| log::warn!("no control group can be made: {error}"));
        let cgroup = Cgroup(made.ok()?.keep());
        // A simulation that runs out of memory is killed as a whole.
        let mut settings = vec![
            ("pids.max", (limits.processes + RUNNERS).to_string()),
            ("memory.oom.group", "1".to_owned()),
        ];
        if let Some(memory) = limits.memory {
            settings.push(("memory.max", (memory << 20).to_string()));
            // Otherwise it would take the machine's swap too.
            settings.push(("memory.swap.max", "0".to_owned()));
        }
        settings.extend(
            limits
                .cores
                .map(|cores| ("cpu.max", format!("{} {PERIOD}", cores * PERIOD))),
        );
        for (file, value) in settings {
            let file = cgroup.0.join(file);
            // Without the controller, there is no such file.
            if file.exists()
                && let Err(error) = std::fs::write(&file, &value)
            {
                log::warn!("{} can't be set to {value}: {error}", file.display());
            }
        }
        Some(cgroup)
    }
}

impl Cgroup {
    /// The prefix of a command that runs it in this group.
    pub fn joining(&self) -> Vec<OsString> {
        let words = ["/bin/sh", "-c", "echo 0 >\"$0\" && exec \"$@\""].map(OsString::from);
        words
            .into_iter()
            .chain(std::iter::once(self.0.join("cgroup.procs").into()))
            .collect()
    }

    /// Kills all processes inside. Returns why the kernel had killed one, if it had, and the resources that they have
    /// used. Blocks until they have exited, for two seconds at most.
    pub fn end(&self) -> (Option<Cause>, ResourceUsage) {
        kill(&self.0);
        let events = std::fs::read_to_string(self.0.join("memory.events")).unwrap_or_default();
        // `memory.peak` exists since Linux 5.19.
        let taken = ResourceUsage {
            memory: number_in(&self.0.join("memory.peak")),
            time: cgroup_time(&self.0),
        };
        (kill_for_memory(&events), taken)
    }
}

/// Why the kernel has killed a process of a group, by the group's `memory.events`: `oom_kill` counts those killed for
/// any lack of memory, `oom` how often the group was at its own limit (Linux, `Documentation/admin-guide/cgroup-v2.rst`).
fn kill_for_memory(events: &str) -> Option<Cause> {
    let has = |name: &str| {
        let mut counts = events.lines().filter_map(|line| line.split_once(' '));
        counts.any(|(key, count)| key == name && count != "0")
    };
    has("oom_kill").then(|| {
        if has("oom") {
            Cause::MemoryLimit
        } else {
            Cause::OutOfMemory
        }
    })
}

/// The CPU time of all that has run in a group.
fn cgroup_time(folder: &Path) -> Option<Duration> {
    let times = std::fs::read_to_string(folder.join("cpu.stat")).ok()?;
    let time = times.lines().find_map(|line| line.strip_prefix("usage_usec "))?;
    time.trim().parse().ok().map(Duration::from_micros)
}

/// The number in a file of the kernel.
fn number_in(file: &Path) -> Option<u64> {
    std::fs::read_to_string(file).ok()?.trim().parse().ok()
}

/// Kills all processes in a group, including those that are forked meanwhile.
fn kill(folder: &Path) {
    let deadline = Instant::now() + VANISH;
    let events = || std::fs::read_to_string(folder.join("cgroup.events"));
    while events().is_ok_and(|events| events.contains("populated 1")) && Instant::now() < deadline {
        std::fs::write(folder.join("cgroup.kill"), "1").ok();
        std::thread::sleep(PAUSE);
    }
}

impl Drop for Cgroup {
    fn drop(&mut self) {
        let folder = std::mem::take(&mut self.0);
        let remove = move || {
            kill(&folder);
            if let Err(error) = std::fs::remove_dir(&folder) {
                log::warn!("{} can't be removed: {error}", folder.display());
            }
        };
        // If no thread can be started, systemd removes the group with the unit.
        drop(std::thread::Builder::new().spawn(remove));
    }
}

/// The controllers that are available below a group.
fn offered(folder: &Path) -> io::Result<Vec<&'static str>> {
    let offered = std::fs::read_to_string(folder.join("cgroup.controllers"))?;
    let is_offered = |name: &&str| offered.split_whitespace().any(|one| one == *name);
    Ok(CONTROLLERS.into_iter().filter(is_offered).collect())
}

/// The directory of this server's control group; `None` if other processes are in it.
fn own_folder() -> Option<PathBuf> {
    let me = Process::myself().ok()?;
    let mounts = me.mountinfo().ok()?;
    let mount = mounts
        .into_iter()
        .find(|mount| mount.fs_type == "cgroup2" && mount.root == "/")?;
    let group = me.cgroups().ok()?.into_iter().find(|group| group.hierarchy == 0)?;
    let below = Path::new(&group.pathname)
        .strip_prefix("/")
        .ok()
        .filter(|path| !path.as_os_str().is_empty())?;
    let folder = mount.mount_point.join(below);
    // A process that takes over from another is in the group that that has made for itself, and divides no other.
    if let Some(parent) = folder.parent().filter(|_| folder.ends_with(OWN))
        && std::fs::read_to_string(parent.join("cgroup.procs")).is_ok_and(|inside| inside.is_empty())
    {
        return Some(parent.to_owned());
    }
    let inside = std::fs::read_to_string(folder.join("cgroup.procs")).ok()?;
    let is_alone = inside.lines().eq(std::iter::once(me.pid().to_string().as_str()));
    is_alone.then_some(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_group_that_is_killed_below_its_limit_is_told_apart() {
        let events = |oom, kills| format!("low 0\nhigh 0\nmax 7\noom {oom}\noom_kill {kills}\noom_group_kill 0\n");
        assert_eq!(kill_for_memory(&events(1, 3)), Some(Cause::MemoryLimit));
        assert_eq!(kill_for_memory(&events(0, 3)), Some(Cause::OutOfMemory));
        // An allocation was refused, and nothing was killed.
        assert_eq!(kill_for_memory(&events(1, 0)), None);
        // Without the controller there is no such file.
        assert_eq!(kill_for_memory(""), None);
    }
}
