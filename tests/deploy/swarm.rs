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
    assert_eq!(read("swarm/simulation-gpu.json"), read("kubernetes/overlays/gpu/simulation.json"));
    let rules = |file: &str, beginning: &str| -> Vec<String> {
        read(file).lines().map(str::trim).filter(|line| line.starts_with(beginning)).map(str::to_owned).collect()
    };
    let (swarm, kubernetes, door) = ("swarm/door.conf", "kubernetes/base/config/fleet.conf", "nginx-door.conf");
    let proxy = ["proxy_read_timeout ", "proxy_connect_timeout ", "proxy_pass http://$fleet_address"];
    for beginning in ["rewrite ", "add_header ", "location ", "if ("].into_iter().chain(proxy) {
        assert!(!rules(swarm, beginning).is_empty(), "{beginning}");
        assert_eq!(rules(swarm, beginning), rules(kubernetes, beginning));
    }
    // What keeps secrets from Webots, and forged headers from servers, is that of every door.
    for header in ["Authorization", "Cookie", "X-Forwarded-User", "X-Forwarded-For", "Forwarded", "Host", "Upgrade"] {
        let rule = format!("proxy_set_header {header} ");
        let wanted = rules(door, &rule);
        assert!(!wanted.is_empty(), "{header}");
        assert_eq!([rules(swarm, &rule), rules(kubernetes, &rule)], [wanted.clone(), wanted]);
    }
}
