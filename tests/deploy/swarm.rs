//! `deploy/swarm`: that it is the fleet which `deploy/kubernetes` has for the demo. `tests/swarm.sh` runs it.

use std::path::Path;

fn read(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(path)).unwrap()
}

#[test]
fn its_servers_and_its_door_are_those_of_the_demo_on_kubernetes() {
    for file in ["session.json", "simulation.json"] {
        assert_eq!(read(&format!("swarm/{file}")), read(&format!("kubernetes/overlays/demo/{file}")), "{file}");
    }
    let [swarm, kubernetes] = ["swarm/door.conf", "kubernetes/base/config/fleet.conf"].map(read);
    for rule in
        ["rewrite ", "add_header ", "location ", "if (", "proxy_read_timeout ", "proxy_pass http://$fleet_address"]
    {
        let rules = |conf: &str| -> Vec<String> {
            conf.lines().map(str::trim).filter(|line| line.starts_with(rule)).map(str::to_owned).collect()
        };
        assert_eq!(rules(&swarm), rules(&kubernetes));
        assert!(!rules(&swarm).is_empty(), "{rule}");
    }
}

#[test]
fn its_images_are_those_that_the_dockerfile_makes() {
    let (stack, dockerfile) = (read("swarm/stack.yml"), read("docker/Dockerfile"));
    for stage in ["session-server", "simulation-demo"] {
        assert!(stack.contains(&format!("webots-fleet/{stage}:{}", env!("CARGO_PKG_VERSION"))), "{stage}");
        assert!(dockerfile.contains(&format!(" AS {stage}\n")), "{stage}");
    }
}
