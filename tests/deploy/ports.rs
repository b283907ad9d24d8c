//! The ports that rules, configurations and the guide name: the same everywhere, and no more than a fleet has.

use std::ops::RangeInclusive;

use regex_lite::Regex;
use serde_json::Value;

const GUIDE: &str = include_str!("../../docs/deployment.md");
const RULES: [(&str, &str); 2] = [
    ("apache.conf", include_str!("../../deploy/apache.conf")),
    ("nginx.conf", include_str!("../../deploy/nginx.conf")),
];

/// What the first parenthesis of a pattern stands for, wherever a text has it.
fn found<'text>(pattern: &str, text: &'text str) -> Vec<&'text str> {
    Regex::new(pattern).unwrap().captures_iter(text).map(|found| found.get(1).unwrap().as_str()).collect()
}

/// The ports of a simulation server with this configuration, its own and those of Webots.
fn ports(config: &Value) -> RangeInclusive<u16> {
    let number = |key: &str| u16::try_from(config[key].as_u64().unwrap()).unwrap();
    number("port")..=number("port") + number("maxConnections")
}

fn shipped() -> RangeInclusive<u16> {
    ports(&serde_json::from_str(include_str!("../../deploy/config/simulation/main.json")).unwrap())
}

/// Those of the simulation servers that the guide configures: on this machine, and on another behind its web server.
fn in_the_guide() -> Vec<RangeInclusive<u16>> {
    let configs = found(r"(?s)simulation/main\.json >/dev/null <<END\n(.*?)\nEND\n", GUIDE);
    configs.iter().map(|config| ports(&serde_json::from_str(config).unwrap())).collect()
}

#[test]
fn the_rules_forward_the_ports_of_the_configurations_and_no_others() {
    let ranges = in_the_guide();
    assert_eq!(ranges.len(), 2, "{ranges:?}");
    assert_eq!(ranges[0], shipped(), "the package has another configuration than the guide");
    let opened = found(r"to any port (\S+) proto tcp", GUIDE);
    assert_eq!(opened, [format!("{}:{}", ranges[1].start(), ranges[1].end())], "the firewall");
    for (name, rules) in RULES {
        // In what counts, and in what has a '#' in front; WebSockets have rules of their own in Apache.
        let each = if name == "apache.conf" { 2 } else { 1 };
        let servers = if name == "apache.conf" {
            found(r"RewriteRule \^/([0-9]{4})/\(\.\*\)\$ (?:ws|http)://", rules)
        } else {
            found(r"(?m)^  #?([0-9]+) +[0-9.]+:[0-9]+;", rules)
        };
        let wanted = ranges.iter().flat_map(|range| vec![range.start().to_string(); each]);
        assert_eq!(servers, wanted.collect::<Vec<_>>(), "{name}");
        let patterns =
            found(r"(?:RewriteRule|location ~) \^/\((?:\?<fleet_port>)?([0-9|\[\]-]+\|[0-9|\[\]-]+)\)/", rules);
        assert_eq!(patterns.len(), 2 * each, "{name}: {patterns:?}");
        for (pattern, range) in patterns.iter().zip(ranges.iter().flat_map(|range| vec![range; each])) {
            let pattern = Regex::new(&format!("^(?:{pattern})$")).unwrap();
            let forwarded: Vec<u16> = (0..=u16::MAX).filter(|port| pattern.is_match(&port.to_string())).collect();
            // The simulation server has a rule of its own; an editor is at its Webots' port + 500.
            let webots = range.start() + 1..=*range.end();
            let editors = range.start() + 501..=range.end() + 500;
            assert_eq!(forwarded, webots.chain(editors).collect::<Vec<_>>(), "{name}: {pattern}");
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
        // A table has no bare '|'.
        let pattern = Regex::new(&format!("^(?:{})$", row[5].replace(r"\|", "|"))).unwrap();
        let matched: Vec<u16> = (0..=u16::MAX).filter(|port| pattern.is_match(&port.to_string())).collect();
        assert_eq!(matched, (first..=last).collect::<Vec<_>>(), "{pattern}");
    }
}
