//! The commands and files for Kubernetes in docs/scaling.md, as far as they can be run without a cluster.
//! `tests/swarm.sh` runs those for Docker Swarm on a real swarm.
//!
//! | stand-in | for | because |
//! |---|---|---|
//! | a script | `docker` | no images are built: the requested stages must be in the Dockerfile |
//! | a script | `kubectl` | there is no cluster: the applied files must exist, and the real kubectl renders them |

use std::path::Path;
use std::process::Command;

use crate::support::authority::Authority;
use crate::support::make_program;
use crate::support::page::{blocks, commands, page, section};

const DOCKER: &str = r#"while [[ $1 != --file ]]; do shift; done
grep -q " AS $4\$" "$2""#;

const KUBECTL: &str = r#"set -e
PATH=${PATH#*:}
while [[ $1 == --namespace ]]; do shift 2; done
case "$1 $2" in
'apply --kustomize') exec kubectl kustomize "$3" ;;
'apply --filename') test -s "$3" ;;
'create secret') exec kubectl "$@" --dry-run=client ;;
'wait --for=condition=Available' | 'port-forward service/door') ;;
*) exit 1 ;;
esac"#;

/// Runs a command in a folder, with `programs` first in the path; returns its output.
fn run(folder: &Path, programs: &Path, command: &str) -> String {
    let search = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
    let mut bash = Command::new("bash");
    let output = bash
        .args(["-euo", "pipefail", "-c", command])
        .current_dir(folder)
        .env("PATH", search)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{command}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn the_commands_of_the_page_on_kubernetes_apply_what_is_there() {
    needs!("kubectl");
    let text = section(&page("scaling.md"), "## Kubernetes");
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let programs = tempfile::tempdir().unwrap();
    let own = tempfile::tempdir().unwrap();
    make_program(&programs.path().join("docker"), DOCKER);
    make_program(&programs.path().join("kubectl"), KUBECTL);
    let files = own.path().join("webots-fleet");
    std::fs::create_dir(&files).unwrap();
    assert!(
        Command::new("cp")
            .arg("-R")
            .arg(project.join("deploy"))
            .arg(&files)
            .status()
            .unwrap()
            .success()
    );
    std::fs::write(own.path().join("kustomization.yaml"), &blocks(&text, "yaml")[0]).unwrap();
    std::fs::copy(
        files.join("deploy/kubernetes/base/config/simulation.json"),
        own.path().join("simulation.json"),
    )
    .unwrap();
    let authority = Authority::new();
    let commands = commands(&text);
    let certificate = authority.issue(&["fleet.lab.example"]);
    std::fs::copy(certificate.chain, own.path().join("tls.crt")).unwrap();
    std::fs::copy(certificate.key, own.path().join("tls.key")).unwrap();
    let (demo, rest) = commands.split_at(4);
    demo.iter()
        .for_each(|command| drop(run(project, programs.path(), command)));
    let applied: Vec<String> = rest
        .iter()
        .map(|command| run(own.path(), programs.path(), command))
        .collect();
    for words in [
        "registry.lab.example/simulation-server:",
        "wss://fleet.lab.example/{host}/{port}",
    ] {
        assert!(applied.last().unwrap().contains(words), "{words} is not in {applied:?}");
    }
}
