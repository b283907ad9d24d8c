//! Which of several builds have filled the disk of Docker.
//!
//! Docker does not tell to which build a container belongs. Each build has a host name of its own (`--add-host`), which the
//! containers of its steps have in their settings; their image is that of the step before. A step that copies files has no
//! container, and a pull has none: these have written what no container has.

use std::collections::BTreeMap;

use super::docker::{Docker, DockerError, SHORT_TIMEOUT};
use super::dockerfile::LABEL;

/// The mark of a build.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct BuildMark(String);

/// The prefix of the names of simulations' containers. Other containers have names from Docker.
const SIMULATIONS: &str = "webots-fleet-";
/// What is before a label that a Dockerfile has set, in the history of an image.
const SETS: &str = "/bin/sh -c #(nop)  LABEL";

impl BuildMark {
    /// A new mark. No name below `.invalid` is ever registered.
    pub fn new() -> Self {
        Self(format!("build-{:016x}.webots-fleet.invalid", rand::random::<u64>()))
    }

    /// The option of `docker build` that sets it.
    pub fn option(&self) -> [String; 2] {
        ["--add-host".to_owned(), format!("{}:127.0.0.1", self.0)]
    }

    fn is_in(&self, hosts: &str) -> bool {
        hosts.contains(&self.0)
    }
}

/// What those of these builds have written so far that have a container now, in bytes.
///
/// # Errors
/// When Docker does not tell.
pub async fn written(docker: &Docker, builds: &[BuildMark]) -> Result<BTreeMap<BuildMark, u64>, DockerError> {
    let list = docker
        .run(&["ps", "--format", "{{.ID}} {{.Names}}"], SHORT_TIMEOUT)
        .await?;
    let mut written = BTreeMap::new();
    for (id, name) in list.lines().filter_map(|line| line.split_once(' ')) {
        if !name.starts_with(SIMULATIONS)
            && let Some((mark, size)) = growth(docker, id, builds).await
        {
            written.insert(mark.clone(), size);
        }
    }
    Ok(written)
}

/// The builds that may have filled the disk, which has lost this many bytes since the first of them began: the one with a
/// container that has written half of that, or else those without one. All, if each has a container.
pub fn fillers(builds: &[BuildMark], written: &BTreeMap<BuildMark, u64>, lost: u64) -> Vec<BuildMark> {
    let largest = written.iter().max_by_key(|(_, size)| **size);
    if let Some((mark, _)) = largest.filter(|(_, size)| **size >= lost / 2) {
        return vec![mark.clone()];
    }
    let without: Vec<BuildMark> = builds
        .iter()
        .filter(|mark| !written.contains_key(mark))
        .cloned()
        .collect();
    if without.is_empty() { builds.to_vec() } else { without }
}

/// The build of a container, and what it has written; `None` if it is of no build, or has ended meanwhile.
async fn growth<'builds>(
    docker: &Docker,
    container: &str,
    builds: &'builds [BuildMark],
) -> Option<(&'builds BuildMark, u64)> {
    let inspect = [
        "inspect",
        "--format",
        "{{.Image}} {{json .HostConfig.ExtraHosts}}",
        container,
    ];
    let about = docker.run(&inspect, SHORT_TIMEOUT).await.ok()?;
    let (image, hosts) = about.split_once(' ')?;
    let mark = builds.iter().find(|mark| mark.is_in(hosts))?;
    let inspect = ["inspect", "--size", "--format", "{{.SizeRw}}", container];
    let written: u64 = docker.run(&inspect, SHORT_TIMEOUT).await.ok()?.trim().parse().ok()?;
    let history = [
        "history",
        "--no-trunc",
        "--human=false",
        "--format",
        "{{.Size}} {{.CreatedBy}}",
        image,
    ];
    let steps = docker.run(&history, SHORT_TIMEOUT).await.ok()?;
    Some((mark, written + of_this_stage(&steps)))
}

/// The size of the layers that the steps of a stage have made, from the history of its image, the latest first. A stage
/// begins with the label of its owner; a project may repeat that, so the oldest counts.
fn of_this_stage(history: &str) -> u64 {
    let label = format!("{SETS} {LABEL}=");
    let steps: Vec<(&str, &str)> = history.lines().filter_map(|line| line.split_once(' ')).collect();
    let begin = steps.iter().rposition(|(_, by)| by.starts_with(&label));
    let own = steps.iter().take(begin.map_or(0, |begin| begin + 1));
    own.filter_map(|(size, _)| size.parse::<u64>().ok()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_begins_with_the_oldest_label_of_the_owner() {
        let label = "0 /bin/sh -c #(nop)  LABEL webots-fleet.owner=a";
        let history =
            format!("5 /bin/sh -c b\n{label}\n7 /bin/sh -c echo LABEL webots-fleet.owner=\n{label}\n100 base\n");
        assert_eq!(of_this_stage(&history), 12);
        assert_eq!(of_this_stage("100 base\n"), 0);
    }

    #[test]
    fn what_no_container_has_written_was_copied_or_pulled() {
        let [a, b, c] = ["a", "b", "c"].map(|name| BuildMark(name.to_owned()));
        let builds = [a.clone(), b.clone(), c.clone()];
        for (written, found, why) in [
            (vec![(&a, 60), (&b, 30)], vec![&a], "it has written most"),
            (vec![(&a, 10), (&b, 10)], vec![&c], "the only one that copies"),
            (vec![(&a, 10)], vec![&b, &c], "one of two that copy"),
            (vec![], vec![&a, &b, &c], "all copy"),
            (
                vec![(&a, 10), (&b, 10), (&c, 10)],
                vec![&a, &b, &c],
                "all have written little",
            ),
        ] {
            let written = written.into_iter().map(|(mark, size)| (mark.clone(), size)).collect();
            assert_eq!(
                fillers(&builds, &written, 100).iter().collect::<Vec<_>>(),
                found,
                "{why}"
            );
        }
    }
}
