//! The shipped configuration files, and `docs/configuration.md`, which explains every key.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};
use webots_fleet::session::config::SessionConfig;
use webots_fleet::shared::config::Configuration;
use webots_fleet::simulation::config::SimulationConfig;

use super::copy::{root, walk};

/// A server: its program, its section of the page, and the aliases of its keys.
struct Kind {
    program: &'static str,
    heading: &'static str,
    aliases: &'static [&'static str],
    /// The configuration with the fewest keys.
    smallest: Value,
}

fn kinds() -> [Kind; 2] {
    [
        Kind {
            program: env!("CARGO_BIN_EXE_session-server"),
            heading: "## Session server",
            aliases: SessionConfig::ALIASES,
            smallest: json!({"simulationServers": []}),
        },
        Kind {
            program: env!("CARGO_BIN_EXE_simulation-server"),
            heading: "## Simulation server",
            aliases: SimulationConfig::ALIASES,
            smallest: json!({}),
        },
    ]
}

impl Kind {
    /// Runs `--check` on the text of a configuration.
    fn check(&self, config: &str) -> Output {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), config).unwrap();
        check(self.program, file.path())
    }

    /// Every key with its default; nested keys as `part.key`.
    fn defaults(&self) -> BTreeMap<String, Value> {
        let output = self.check(&self.smallest.to_string());
        let Value::Object(all) = serde_json::from_slice(&output.stdout).unwrap() else {
            panic!("{output:?}")
        };
        let mut keys = BTreeMap::new();
        for (key, value) in all {
            match value {
                Value::Object(part) if !part.is_empty() => {
                    keys.extend(part.into_iter().map(|(inner, value)| (format!("{key}.{inner}"), value)));
                }
                value => drop(keys.insert(key, value)),
            }
        }
        keys
    }

    /// Its section of the page.
    fn page(&self) -> String {
        let page = std::fs::read_to_string(root().join("docs/configuration.md")).unwrap();
        let (_, part) = page.split_once(&format!("{}\n", self.heading)).unwrap();
        part.split("\n## ").next().unwrap().to_owned()
    }

    /// What `--schema` prints.
    fn schema(&self) -> Value {
        let output = Command::new(self.program).arg("--schema").output().unwrap();
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
        serde_json::from_slice(&output.stdout).unwrap()
    }

    /// The rows of the page's tables: each key, its documented kind of value, and its default.
    fn rows(&self) -> Vec<(String, String, String)> {
        let page = self.page();
        let rows = page.lines().filter_map(|line| line.strip_prefix("| `"));
        rows.map(|row| {
            let cells: Vec<&str> = row.split(" | ").collect();
            (
                cells[0].trim_end_matches('`').to_owned(),
                cells[1].to_owned(),
                cells[2].to_owned(),
            )
        })
        .collect()
    }
}

/// Runs `--check`; of its messages, keeps only those about the file.
fn check(program: &str, file: &Path) -> Output {
    let output = Command::new(program)
        .arg("--check")
        .arg(file)
        .env_remove("WEBOTS_HOME")
        .output()
        .unwrap();
    let name = file.display().to_string();
    let remarks = String::from_utf8(output.stderr).unwrap();
    let about: Vec<&str> = remarks.lines().filter(|line| line.contains(&name)).collect();
    Output {
        stderr: about.join("\n").into_bytes(),
        ..output
    }
}

#[test]
fn every_shipped_configuration_is_taken_without_a_warning() {
    for (kind, name) in kinds().iter().zip(["session", "simulation"]) {
        let mut files = walk(&root().join("config").join(name));
        files.retain(|file| file.extension().is_some_and(|extension| extension == "json"));
        assert!(files.len() >= 2, "{files:?}");
        let packaged = root().join("deploy/config").join(name).join("main.json");
        for file in files.iter().chain([&packaged]) {
            let output = check(kind.program, file);
            assert!(
                output.status.success() && output.stderr.is_empty(),
                "{}: {output:?}",
                file.display()
            );
            let config: Value = serde_json::from_slice(&output.stdout).unwrap();
            assert!(
                *file != packaged || config["bind"] == "127.0.0.1",
                "the package's is reached from outside"
            );
        }
    }
}

#[test]
fn the_page_names_every_key_once_with_its_default_and_no_other() {
    for kind in kinds() {
        let defaults = kind.defaults();
        let rows = kind.rows();
        let mut named: Vec<&str> = rows.iter().map(|(key, ..)| key.as_str()).collect();
        named.sort_unstable();
        let known: Vec<&str> = defaults.keys().map(String::as_str).collect();
        assert_eq!(named, known, "{}", kind.heading);
        for alias in kind.aliases {
            assert!(kind.page().contains(&format!("`{alias}`")), "{alias}");
        }
        for (key, _, told) in &rows {
            let default = &defaults[key];
            if told == "required" {
                let output = kind.check("{}");
                let told = String::from_utf8_lossy(&output.stderr);
                assert!(
                    output.status.code() == Some(2) && told.ends_with(&format!(" {key}: it is missing")),
                    "{told}"
                );
            } else {
                assert_eq!(is_default(told, default), Ok(()), "{key}");
            }
        }
    }
}

/// Whether the page tells this default.
fn is_default(told: &str, default: &Value) -> Result<(), String> {
    let is_told = if told == "none" {
        [json!(null), json!([]), json!({})].contains(default)
    } else {
        let value: Value = serde_json::from_str(told.trim_matches('`')).map_err(|error| format!("{told}: {error}"))?;
        match (value.as_f64(), default.as_f64()) {
            (Some(one), Some(other)) => one == other,
            _ => value == *default,
        }
    };
    let problem = || format!("the page says {told}, it is {default}");
    is_told.then_some(()).ok_or_else(problem)
}

/// The kinds of JSON values that a schema allows: `string`, `array`, ...
fn types(schema: &Value) -> Vec<&str> {
    let own = match &schema["type"] {
        Value::String(one) => vec![one.as_str()],
        Value::Array(many) => many.iter().filter_map(Value::as_str).collect(),
        _ => Vec::new(),
    };
    let others = ["anyOf", "oneOf"].map(|way| schema[way].as_array().into_iter().flatten());
    own.into_iter()
        .chain(others.into_iter().flatten().flat_map(types))
        .collect()
}

/// The smallest and the largest number that the page tells for a kind of value.
fn bounds(told: &str) -> Option<(f64, f64)> {
    if told == "seconds" {
        return Some((0.01, 31_536_000.0));
    }
    let (least, most) = told.rsplit(", ").next()?.split_once(" to ")?;
    Some((least.parse().ok()?, most.parse().ok()?))
}

#[test]
fn the_schema_has_the_keys_kinds_and_defaults_of_the_page() {
    for kind in kinds() {
        let schema = kind.schema();
        assert_eq!(schema["additionalProperties"], false);
        let properties = schema["properties"].as_object().unwrap();
        let is_own = |key: &str| key != "$schema" && !kind.aliases.contains(&key);
        let mut keys = BTreeMap::new();
        for (key, about) in properties.iter().filter(|(key, _)| is_own(key)) {
            match about["properties"].as_object() {
                Some(part) => keys.extend(part.iter().map(|(inner, about)| (format!("{key}.{inner}"), about))),
                None => drop(keys.insert(key.clone(), about)),
            }
        }
        let rows = kind.rows();
        let mut named: Vec<&str> = rows.iter().map(|(key, ..)| key.as_str()).collect();
        named.sort_unstable();
        assert_eq!(named, keys.keys().map(String::as_str).collect::<Vec<_>>());
        assert!(kind.aliases.iter().all(|alias| properties.contains_key(*alias)));
        for (key, told, default) in &rows {
            let about = keys[key];
            if default == "required" {
                assert_eq!(schema["required"], json!([key]));
            } else {
                assert_eq!(is_default(default, &about["default"]), Ok(()), "{key}");
            }
            let of_schema = about["minimum"].as_f64().zip(about["maximum"].as_f64());
            assert_eq!(bounds(told), of_schema, "{key}: {told}: {about}");
            let types = types(about);
            let expected = match told.as_str() {
                "true or false" => "boolean",
                "URL prefixes and replacements" => "object",
                _ if bounds(told).is_some() => *types.iter().find(|one| ["integer", "number"].contains(one)).unwrap(),
                _ if told.starts_with("list") || told == "addresses and networks" => "array",
                _ => "string",
            };
            assert!(types.contains(&expected), "{key}: {told}: {about}");
            if told.contains(" or list") {
                assert!(types.contains(&"array"), "{key}: {told}: {about}");
            }
            let choices = about["oneOf"].as_array().into_iter().flatten();
            for choice in choices.map(|choice| choice["const"].to_string()) {
                assert!(kind.page().contains(&choice), "{key}: the page does not name {choice}");
            }
        }
    }
}

#[test]
fn the_examples_of_the_pages_are_taken_without_a_warning() {
    let embedding = std::fs::read_to_string(root().join("docs/embedding.md")).unwrap();
    let [session, simulation] = kinds();
    for (kind, page) in [
        (&session, session.page()),
        (&simulation, simulation.page()),
        (&session, embedding),
    ] {
        let examples: Vec<&str> = page
            .split("```json\n")
            .skip(1)
            .map(|text| text.split("```").next().unwrap())
            .collect();
        assert!(!examples.is_empty(), "{page}");
        for example in examples {
            let output = kind.check(example);
            assert!(
                output.status.success() && output.stderr.is_empty(),
                "{example}{output:?}"
            );
        }
    }
}

#[test]
fn a_mistyped_key_is_told_last_and_fails_the_check() {
    for kind in kinds() {
        let mut config = kind.smallest.clone();
        for key in ["maxClinets", "adminPasword", "colour", "$schema"] {
            config[key] = json!("x");
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), config.to_string()).unwrap();
        let output = Command::new(kind.program)
            .arg("--check")
            .arg(file.path())
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        let told = String::from_utf8(output.stderr).unwrap();
        let lines: Vec<&str> = told.lines().collect();
        let expected = [
            "unknown key \"adminPasword\" is ignored; did you mean \"adminPassword\"?",
            "unknown key \"colour\" is ignored",
            "unknown key \"maxClinets\" is ignored; did you mean \"maxClients\"?",
        ];
        let expected = expected.map(|words| format!("error: {}: {words}", file.path().display()));
        assert!(lines.ends_with(&expected.each_ref().map(String::as_str)), "{told}");
        assert!(!told.contains("$schema"), "{told}");
        let shown: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert!(shown["port"].is_number(), "the effective configuration is printed too");
    }
}

#[test]
fn values_come_from_files_and_the_environment() {
    let [session, simulation] = kinds();
    let secret = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(secret.path(), "s3cret\n").unwrap();
    for (kind, key) in [(session, "mailSenderPassword"), (simulation, "adminPassword")] {
        let with = |value: Value| {
            let mut config = kind.smallest.clone();
            config[key] = value;
            kind.check(&config.to_string())
        };
        let output = with(json!({"file": secret.path()}));
        let shown: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(shown[key], "********");
        for (value, words) in [
            (json!({"file": "/nowhere"}), "/nowhere: can't be read: No such file"),
            (json!({"file": "/dev/zero"}), "it is not a regular file"),
            (json!({"path": "/nowhere"}), "neither a text nor"),
        ] {
            let output = with(value);
            let told = String::from_utf8_lossy(&output.stderr);
            assert_eq!((output.status.code(), told.lines().count()), (Some(2), 1), "{told}");
            assert!(told.contains(key) && told.contains(words), "{told}");
        }
        let output = kind.check(r#"{"simulationServers": [], "publicUrl": "$NOWHERE"}"#);
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(
            output.status.code() == Some(2) && told.contains("publicUrl") && told.contains("NOWHERE"),
            "{told}"
        );
    }
}
