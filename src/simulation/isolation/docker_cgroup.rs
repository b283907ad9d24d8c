//! What the kernel has counted for a container, in the control groups that Docker makes. They vanish with the container.

use std::path::Path;
use std::time::Duration;

use super::cgroup::taken_in;
use crate::simulation::ends::Taken;

/// Where control groups are.
const ROOT: &str = "/sys/fs/cgroup";

/// Where the control group of a container is below each hierarchy, with systemd and without.
fn names(container: &str) -> [String; 2] {
    [format!("system.slice/docker-{container}.scope"), format!("docker/{container}")]
}

/// What a container has taken until now, as far as the kernel counts it, in control groups of either version.
pub fn taken_by_container(container: &str) -> Taken {
    let of_version_2 = names(container).map(|name| taken_in(&Path::new(ROOT).join(name)));
    let number = |controller: &str, name: &str, file| {
        std::fs::read_to_string(Path::new(ROOT).join(controller).join(name).join(file)).ok()?.trim().parse().ok()
    };
    let of_version_1 = names(container).map(|name| Taken {
        memory: number("memory", &name, "memory.max_usage_in_bytes"),
        time: number("cpuacct", &name, "cpuacct.usage").map(Duration::from_nanos),
    });
    let all = || of_version_2.iter().chain(&of_version_1);
    Taken { memory: all().find_map(|taken| taken.memory), time: all().find_map(|taken| taken.time) }
}
