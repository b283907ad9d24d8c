//! The port patterns in web server rules and in the documentation: they match the ports of a fleet and no others.

use regex_lite::Regex;
use serde_json::Value;

const RULES: [(&str, &str); 2] = [
    ("apache.conf", include_str!("../../deploy/apache.conf")),
    ("nginx.conf", include_str!("../../deploy/nginx.conf")),
];

/// The ports that a pattern matches.
fn matched(pattern: &str) -> Vec<u16> {
    let pattern = Regex::new(&format!("^(?:{pattern})$")).unwrap();
    (0..=u16::MAX)
        .filter(|port| pattern.is_match(&port.to_string()))
        .collect()
}

#[test]
fn the_rules_forward_only_configured_ports() {
    let config: Value = serde_json::from_str(include_str!("../../deploy/config/simulation/main.json")).unwrap();
    let [port, places] = ["port", "maxConnections"].map(|key| u16::try_from(config[key].as_u64().unwrap()).unwrap());
    let pattern = Regex::new(r"\^/\((?:\?<fleet_port>)?([0-9|\[\]-]+\|[0-9|\[\]-]+)\)/").unwrap();
    for (name, rules) in RULES {
        let patterns: Vec<&str> = pattern
            .captures_iter(rules)
            .map(|found| found.get(1).unwrap().as_str())
            .collect();
        // One for this machine, and one for another machine, commented out. Apache has separate rules for WebSockets.
        let each = if name == "apache.conf" { 2 } else { 1 };
        assert_eq!(patterns.len(), 2 * each, "{name}: {patterns:?}");
        for (pattern, first) in patterns
            .iter()
            .zip([port, 3000].iter().flat_map(|first| vec![first; each]))
        {
            // The simulation server has a rule of its own; an editor is at its Webots' port + 500.
            let webots = first + 1..=first + places;
            let editors = first + 501..=first + places + 500;
            assert_eq!(
                matched(pattern),
                webots.chain(editors).collect::<Vec<_>>(),
                "{name}: {pattern}"
            );
        }
    }
}

#[test]
fn the_documentation_names_patterns_for_what_they_match() {
    let page = include_str!("../../docs/deployment-web-server.md");
    let row = Regex::new(r"\| ([0-9]+) \| ([0-9]+) \| ([0-9]+) to ([0-9]+) \| `(\S+)` \|").unwrap();
    let rows: Vec<_> = row.captures_iter(page).collect();
    assert!(rows.len() >= 3, "{rows:?}");
    for row in rows {
        let [port, places, first, last] = [1, 2, 3, 4].map(|column| row[column].parse::<u16>().unwrap());
        assert_eq!((port, port + places), (first, last), "{row:?}");
        // Markdown tables escape '|'.
        assert_eq!(
            matched(&row[5].replace(r"\|", "|")),
            (first..=last).collect::<Vec<_>>(),
            "{row:?}"
        );
    }
}
