//! `deploy/kubernetes` and the images that it names, checked by programs that read such files; without a cluster.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;

use serde_json::Value;

use crate::support::skip;

fn project(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn text(output: Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// The output of kustomize for a folder, as text and as objects.
struct Made {
    name: &'static str,
    yaml: String,
    objects: Vec<Value>,
}

#[test]
fn no_autoscaler_ends_what_drains() {
    for made in ALL.iter() {
        for name in ["simulation", "door"] {
            let deployment = made
                .objects
                .iter()
                .find(|object| object["kind"] == "Deployment" && object["metadata"]["name"] == name)
                .unwrap();
            let annotations = &deployment["spec"]["template"]["metadata"]["annotations"];
            let key = "cluster-autoscaler.kubernetes.io/safe-to-evict";
            assert_eq!(annotations[key], "false", "{}: {name}", made.name);
        }
    }
}

#[test]
fn the_logs_of_a_swarms_servers_are_limited() {
    let stack = std::fs::read_to_string(project("deploy/swarm/stack.yml")).unwrap();
    let stack: Value = serde_saphyr::from_str(&stack).unwrap();
    for (name, service) in stack["services"].as_object().unwrap() {
        assert_eq!(service["logging"]["driver"], "local", "{name}");
        assert_eq!(service["logging"]["options"]["max-size"], "10m", "{name}");
    }
}

/// The base, the overlays, and the base with all components. Empty, with a message, if kubectl is missing or too old.
static ALL: LazyLock<Vec<Made>> = LazyLock::new(|| {
    needs!("kubectl", Vec::new());
    let version = text(
        Command::new("kubectl")
            .args(["version", "--client", "--output=json"])
            .output()
            .unwrap(),
    );
    let version: Value = serde_json::from_str(&version).unwrap();
    let minor = version["clientVersion"]["minor"]
        .as_str()
        .unwrap()
        .trim_end_matches('+')
        .parse::<u32>()
        .unwrap();
    if minor < 25 {
        skip("kubectl is older than 1.25");
        return Vec::new();
    }
    let make = |name, folder: &Path| {
        let yaml = text(Command::new("kubectl").arg("kustomize").arg(folder).output().unwrap());
        Made {
            name,
            objects: serde_saphyr::from_multiple(&yaml).unwrap(),
            yaml,
        }
    };
    let folder = tempfile::tempdir().unwrap();
    // kustomize accepts only relative paths.
    let up = "../".repeat(folder.path().canonicalize().unwrap().components().count() - 1);
    let files = format!(
        "{up}{}",
        project("deploy/kubernetes")
            .display()
            .to_string()
            .trim_start_matches('/')
    );
    let own = format!(
        "resources: [{files}/base]\ncomponents: [{files}/components/monitoring, {files}/components/autoscaling]\n"
    );
    std::fs::write(folder.path().join("kustomization.yaml"), own).unwrap();
    let shipped = ["base", "overlays/demo", "overlays/gpu"];
    let shipped = shipped.map(|name| make(name, &project("deploy/kubernetes").join(name)));
    shipped
        .into_iter()
        .chain([make("base with components", folder.path())])
        .collect()
});

fn of_kind<'all>(objects: &'all [Value], kind: &str) -> Vec<&'all Value> {
    objects.iter().filter(|object| object["kind"] == kind).collect()
}

/// A value of a generated ConfigMap, whose name ends with a hash.
fn settings<'all>(objects: &'all [Value], name: &str, key: &str) -> &'all str {
    let is_it = |map: &&&Value| map["metadata"]["name"].as_str().unwrap().rsplit_once('-').unwrap().0 == name;
    of_kind(objects, "ConfigMap").iter().find(is_it).unwrap()["data"][key]
        .as_str()
        .unwrap()
}

#[test]
fn what_kustomize_makes_conforms_to_the_schemas() {
    let dockerfile = std::fs::read_to_string(project("deploy/docker/Dockerfile")).unwrap();
    let python = text(Command::new(project("tests/python.sh")).output().unwrap());
    for Made { name, yaml, objects } in &*ALL {
        let file = tempfile::Builder::new().suffix(".yaml").tempfile().unwrap();
        std::fs::write(file.path(), yaml).unwrap();
        let mut validate = Command::new(python.trim());
        let output = validate
            .args(["-m", "kubernetes_validate", "--strict"])
            .arg(file.path())
            .output()
            .unwrap();
        let told = String::from_utf8_lossy(&output.stdout);
        let passed = told.lines().filter(|line| line.contains(" passed ")).count();
        // The schemas contain only the kinds of Kubernetes itself.
        let own = objects
            .iter()
            .filter(|object| object["kind"] != "ServiceMonitor")
            .count();
        assert!(passed == own && own >= 17, "{name}: {passed} of {own}\n{told}");
        assert!(
            !told.contains("ERROR") || *name == "base with components",
            "{name}: {told}"
        );
        for image in yaml
            .split("image: webots-fleet/")
            .skip(1)
            .filter_map(|rest| rest.lines().next())
        {
            let (stage, tag) = image.split_once(':').unwrap();
            assert!(
                dockerfile.contains(&format!(" AS {stage}\n")) && tag == env!("CARGO_PKG_VERSION"),
                "{name}: {image}"
            );
        }
    }
}

#[test]
fn pods_pass_the_restricted_standard_but_for_the_nodes_display() {
    for Made { name, objects, .. } in &*ALL {
        let namespace = &of_kind(objects, "Namespace")[0]["metadata"]["labels"]["pod-security.kubernetes.io/enforce"];
        let deployments = of_kind(objects, "Deployment");
        assert_eq!(deployments.len(), 3, "{name}");
        let mut restricted = true;
        for deployment in deployments {
            let pod = &deployment["spec"]["template"]["spec"];
            assert_eq!(pod["securityContext"]["runAsNonRoot"], true, "{name}");
            assert_eq!(
                pod["securityContext"]["seccompProfile"]["type"], "RuntimeDefault",
                "{name}"
            );
            assert_eq!(pod["automountServiceAccountToken"], false, "{name}");
            for container in pod["containers"].as_array().unwrap() {
                let context = &container["securityContext"];
                assert_eq!(context["allowPrivilegeEscalation"], false, "{name}");
                assert_eq!(context["readOnlyRootFilesystem"], true, "{name}");
                assert_eq!(context["capabilities"]["drop"], serde_json::json!(["ALL"]), "{name}");
            }
            let volumes = pod["volumes"].as_array().unwrap();
            restricted &= volumes.iter().all(|volume| volume.get("hostPath").is_none());
        }
        assert_eq!(
            (restricted, namespace == "restricted"),
            (*name != "overlays/gpu", *name != "overlays/gpu"),
            "{name}"
        );
    }
}

#[test]
fn the_configurations_are_taken_as_pods_get_them() {
    let programs = [
        ("session", env!("CARGO_BIN_EXE_session-server")),
        ("simulation", env!("CARGO_BIN_EXE_simulation-server")),
    ];
    for Made { name, objects, .. } in &*ALL {
        for (kind, program) in programs {
            let file = tempfile::NamedTempFile::new().unwrap();
            std::fs::write(file.path(), settings(objects, kind, "config.json")).unwrap();
            let mut command = Command::new(program);
            command.arg("--check").arg(file.path()).env("FLEET_ADDRESS", "10.1.2.3");
            let output = command
                .env("FLEET_URL", settings(objects, "fleet", "FLEET_URL"))
                .output()
                .unwrap();
            let told = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(!told.contains(file.path().to_str().unwrap()), "{name}: {told}");
            let config: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{name}: {told}"));
            let deployment = of_kind(objects, "Deployment")
                .into_iter()
                .find(|one| one["metadata"]["name"] == kind);
            let container = &deployment.unwrap()["spec"]["template"]["spec"]["containers"][0];
            assert_eq!(container["ports"][0]["containerPort"], config["port"], "{name}");
            if kind == "simulation" {
                let first = config["port"].as_u64().unwrap();
                let policies = of_kind(objects, "NetworkPolicy");
                let policy = policies
                    .into_iter()
                    .find(|one| one["metadata"]["name"] == "simulation")
                    .unwrap();
                let ports = &policy["spec"]["ingress"][1]["ports"][0];
                // Streams are relayed by the simulation server.
                assert_eq!(config["streaming"], "relay", "{name}");
                assert_eq!(
                    (ports["port"].as_u64(), ports["endPort"].as_u64()),
                    (Some(first), None),
                    "{name}"
                );
                let grace = deployment.unwrap()["spec"]["template"]["spec"]["terminationGracePeriodSeconds"].as_f64();
                assert!(
                    grace > config["timeout"].as_f64(),
                    "{name}: a simulation would not end by itself"
                );
            }
        }
    }
}

/// `tests/swarm.sh` tests them on Swarm.
#[test]
fn the_servers_and_the_door_on_swarm_are_those_of_the_demo() {
    let read = |path: &str| std::fs::read_to_string(project("deploy").join(path)).unwrap();
    for file in ["session.json", "simulation.json"] {
        assert_eq!(
            read(&format!("swarm/{file}")),
            read(&format!("kubernetes/overlays/demo/{file}")),
            "{file}"
        );
    }
    assert_eq!(
        read("swarm/simulation-gpu.json"),
        read("kubernetes/overlays/gpu/simulation.json")
    );
    let rules = |file: &str, beginning: &str| -> Vec<String> {
        read(file)
            .lines()
            .map(str::trim)
            .filter(|line| line.starts_with(beginning))
            .map(str::to_owned)
            .collect()
    };
    let swarm = "swarm/door.conf";
    let kubernetes = "kubernetes/base/config/fleet.conf";
    let door = "nginx-door.conf";
    let proxy = [
        "proxy_read_timeout ",
        "proxy_connect_timeout ",
        "proxy_pass http://$fleet_address",
    ];
    for beginning in ["rewrite ", "add_header ", "location ", "if ("]
        .into_iter()
        .chain(proxy)
    {
        assert!(!rules(swarm, beginning).is_empty(), "{beginning}");
        assert_eq!(rules(swarm, beginning), rules(kubernetes, beginning));
    }
    // Every door has the same rules that keep secrets from Webots and forged headers from servers.
    for header in [
        "Authorization",
        "Cookie",
        "X-Forwarded-User",
        "X-Forwarded-For",
        "Forwarded",
        "Host",
        "Upgrade",
    ] {
        let rule = format!("proxy_set_header {header} ");
        let wanted = rules(door, &rule);
        assert!(!wanted.is_empty(), "{header}");
        assert_eq!(
            [rules(swarm, &rule), rules(kubernetes, &rule)],
            [wanted.clone(), wanted]
        );
    }
}
