//! The commands and files of docs/scaling.md as they stand, as far as one machine without Docker and without a cluster can try
//! them. `tests/swarm.sh` runs those of the demo on a real Swarm.
//!
//! | stands in | for | because |
//! |---|---|---|
//! | a script that notes what it is asked for | `docker` | there is no Swarm: of a stack, `docker-compose` says what it comes to |
//! | a script | `kubectl` | there is no cluster: what is applied has to be there, and kubectl itself puts it together |

use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

use crate::support::authority::Authority;
use crate::support::needs;
use crate::support::page::{blocks, commands, page, section};

const DOCKER: &str = r#"echo "$*" >>"$CALLS"
case "$1 $2" in
'stack deploy')
    shift 2
    files=()
    while [[ $1 == --* ]]; do
        if [[ $1 == --compose-file ]]; then files+=(--file "$2"); shift; fi
        shift
    done
    docker-compose "${files[@]}" config >"$STACKS/$(ls "$STACKS" | wc -l)" ;;
'node ls') echo node ;;
build\ *)
    while [[ $1 != --file ]]; do shift; done
    grep -q " AS $4\$" "$2" ;;
esac"#;

const KUBECTL: &str = r#"while [[ $1 == --namespace ]]; do shift 2; done
case "$1 $2" in
'apply --kustomize') exec "$KUBECTL" kustomize "$3" ;;
'apply --filename') test -s "$3" ;;
'create secret') exec "$KUBECTL" "$@" --dry-run=client ;;
'wait --for=condition=Available' | 'port-forward service/door') ;;
*) exit 1 ;;
esac"#;

/// A folder with a copy of the project's `deploy`, and programs that stand in for others.
struct Machine {
    folder: tempfile::TempDir,
}

impl Machine {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for part in ["bin", "stacks", "webots-fleet"] {
            std::fs::create_dir(folder.path().join(part)).unwrap();
        }
        let machine = Self { folder };
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy");
        assert!(Command::new("cp").arg("-R").arg(source).arg(machine.project()).status().unwrap().success());
        for (name, text) in [("docker", DOCKER), ("kubectl", KUBECTL)] {
            let path = machine.path("bin").join(name);
            std::fs::write(&path, format!("#!/bin/bash\nset -e\n{text}\n")).unwrap();
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
        }
        machine
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn project(&self) -> PathBuf {
        self.path("webots-fleet")
    }

    /// Runs a command in a folder.
    fn run(&self, folder: &Path, command: &str) -> Output {
        let paths = std::env::var("PATH").unwrap();
        let kubectl = std::env::split_paths(&paths).map(|path| path.join("kubectl")).find(|path| path.is_file());
        let output = Command::new("bash")
            .args(["-euo", "pipefail", "-c", command])
            .current_dir(folder)
            .env("PATH", format!("{}:{paths}", self.path("bin").display()))
            .env("CALLS", self.path("calls"))
            .env("STACKS", self.path("stacks"))
            .env("KUBECTL", kubectl.unwrap_or_default())
            .output()
            .unwrap();
        assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
        output
    }

    /// What the stacks that were deployed come to, the first one first.
    fn stacks(&self) -> Vec<Value> {
        let count = std::fs::read_dir(self.path("stacks")).unwrap().count();
        let read = |index: usize| std::fs::read_to_string(self.path("stacks").join(index.to_string())).unwrap();
        (0..count).map(|index| serde_saphyr::from_str(&read(index)).unwrap()).collect()
    }
}

#[test]
fn the_commands_of_the_page_on_swarm_deploy_what_is_there() {
    needs("docker-compose", "docker-compose");
    let (machine, text) = (Machine::new(), section(&page("scaling.md"), "## Docker Swarm"));
    for command in commands(&text) {
        machine.run(&machine.project(), &command);
    }
    let images = |stack: &Value| {
        let services = stack["services"].as_object().unwrap().iter().filter(|(name, _)| *name != "door");
        services.map(|(_, service)| service["image"].as_str().unwrap().to_owned()).collect::<BTreeSet<_>>()
    };
    let stacks = machine.stacks();
    let (demo, registry) = ("webots-fleet/simulation-demo:0.1.0", "registry.lab.example");
    let expected: [[String; 2]; 4] = [
        ["webots-fleet/session-server:0.1.0".to_owned(), demo.to_owned()],
        [format!("{registry}/session-server:0.1.0"), format!("{registry}/simulation-demo:0.1.0")],
        ["webots-fleet/session-server:0.1.0".to_owned(), "webots-fleet/simulation-server:0.1.0".to_owned()],
        ["webots-fleet/session-server:0.1.0".to_owned(), demo.to_owned()],
    ];
    assert_eq!(stacks.iter().map(images).collect::<Vec<_>>(), expected.map(BTreeSet::from));
    // Each image was made, or pushed, before.
    let calls = std::fs::read_to_string(machine.path("calls")).unwrap();
    for image in stacks.iter().flat_map(images) {
        let made = [format!("--tag {image} "), format!("push {image}\n")];
        assert!(made.iter().any(|words| calls.contains(words)), "{image} comes from nowhere: {calls}");
    }
    assert!(calls.contains("node update --label-add webots-fleet.door=true node\n"), "{calls}");
    assert_eq!(
        stacks[2]["services"]["session"]["environment"]["FLEET_URL"],
        "ws://fleet.example.org:8080/{host}/{port}"
    );
    assert_eq!(stacks[3]["services"]["session"]["environment"]["FLEET_URL"], "wss://fleet.example.org/{host}/{port}");
    // The configurations of a fleet of one's own are those of Kubernetes, which have Xvfb.
    let simulation = std::fs::read_to_string(machine.project().join("deploy/swarm/simulation.json")).unwrap();
    assert!(simulation.contains("\"xvfb\": true"), "{simulation}");
}

#[test]
fn the_files_of_the_page_add_to_the_stack_what_they_say() {
    needs("docker-compose", "docker-compose");
    let (machine, text) = (Machine::new(), section(&page("scaling.md"), "## Docker Swarm"));
    let folder = machine.project().join("deploy/swarm");
    for (index, block) in blocks(&text, "yaml").iter().enumerate() {
        let own = folder.join(format!("own-{index}.yml"));
        std::fs::write(&own, block).unwrap();
        let command = format!("deploy/swarm/deploy --compose-file {} fleet", own.display());
        machine.run(&machine.project(), &command);
    }
    let stacks = machine.stacks();
    assert_eq!(stacks.len(), 2);
    let secret = &stacks[0]["services"]["session"]["secrets"][0];
    assert_eq!(
        (&secret["source"], &secret["target"], &secret["uid"]),
        (&"fleet-mail".into(), &"mail".into(), &"10001".into())
    );
    for name in ["prometheus", "alerts"] {
        let file = stacks[1]["configs"][name]["file"].as_str().unwrap();
        assert!(folder.join(file).is_file(), "{file}");
    }
    assert!(stacks[1]["services"]["prometheus"]["networks"].as_object().is_some_and(|all| all.contains_key("fleet")));
}

#[test]
fn the_commands_of_the_page_on_kubernetes_apply_what_is_there() {
    needs("kubectl", "kubernetes-client");
    let (machine, text) = (Machine::new(), section(&page("scaling.md"), "## Kubernetes"));
    let overlay = &blocks(&text, "yaml")[0];
    std::fs::write(machine.path("kustomization.yaml"), overlay).unwrap();
    let simulation = machine.project().join("deploy/kubernetes/base/config/simulation.json");
    std::fs::copy(simulation, machine.path("simulation.json")).unwrap();
    let authority = Authority::new();
    let certificate = authority.issue(&["fleet.lab.example"]);
    std::fs::copy(certificate.chain, machine.path("tls.crt")).unwrap();
    std::fs::copy(certificate.key, machine.path("tls.key")).unwrap();
    let commands = commands(&text);
    let (demo, own) = commands.split_at(4);
    for command in demo {
        machine.run(&machine.project(), command);
    }
    let mut applied = String::new();
    for command in own {
        applied = String::from_utf8(machine.run(machine.folder.path(), command).stdout).unwrap();
    }
    for words in ["registry.lab.example/simulation-server:", "wss://fleet.lab.example/{host}/{port}"] {
        assert!(applied.contains(words), "{words} is not in {applied}");
    }
}
