//! Reads configuration files: JSON with camelCase keys.
//!
//! An error is one line with the file, the key, what was found and what is expected. An unknown key does not prevent a
//! start, because files of the original may have such keys; `--check` fails.

use std::io;
use std::path::Path;

use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::shared::text::one_line;

/// A server's configuration.
pub trait Configuration: DeserializeOwned + Serialize + JsonSchema {
    /// Aliases of keys.
    const ALIASES: &'static [&'static str] = &[];
    /// Keys that the file must contain.
    const REQUIRED: &'static [&'static str] = &[];

    /// Sets the values that depend on the machine and on the configuration file, and checks the rules between values.
    /// Returns warnings.
    ///
    /// # Errors
    /// When a value contradicts others: its key, what was found, and what is expected.
    fn complete(&mut self, file: &Path) -> Result<Vec<String>, String>;
}

/// Checks a rule for the value of a key; `problem` says what was found, and what is expected.
///
/// # Errors
/// When the rule does not hold.
pub fn require(holds: bool, key: &'static str, problem: impl FnOnce() -> String) -> Result<(), String> {
    if holds {
        Ok(())
    } else {
        Err(format!("{key}: {}", problem()))
    }
}

/// A configuration that was read from a file.
#[derive(Debug)]
pub struct LoadedConfig<C> {
    /// The effective values.
    pub config: C,
    /// Warnings for the administrator, one line each.
    pub warnings: Vec<String>,
    /// The unknown keys, one line each, which are ignored.
    pub unknown: Vec<String>,
}

impl<C> LoadedConfig<C> {
    /// The warnings, and last the unknown keys.
    pub fn remarks(&self) -> Vec<String> {
        self.warnings.iter().chain(&self.unknown).cloned().collect()
    }
}

/// What was read from a file, with lines that do not name the file.
struct Parsed<C> {
    config: C,
    warnings: Vec<String>,
    unknown: Vec<String>,
}

/// The key with which an editor finds the schema of a file.
const SCHEMA: &str = "$schema";
/// A key with at most this many typing errors is recognized; a long one with one more for each `LETTERS` letters.
const TYPING_ERRORS: usize = 2;
const LETTERS: usize = 6;

/// Reads a configuration file.
///
/// # Errors
/// When the file can't be read, or a value is not allowed: one line, with the file.
pub fn load<C: Configuration>(file: &Path) -> Result<LoadedConfig<C>, String> {
    let of_file = |line: String| format!("{}: {line}", file.display());
    let parsed = parse(file).map_err(of_file)?;
    Ok(LoadedConfig {
        config: parsed.config,
        warnings: parsed.warnings.into_iter().map(of_file).collect(),
        unknown: parsed.unknown.into_iter().map(of_file).collect(),
    })
}

/// The JSON schema of a configuration file, for editors: its keys with their kinds of values, defaults and meanings. The
/// rules between values are not in it.
pub fn schema<C: Configuration>() -> Value {
    let settings = SchemaSettings::draft07().with(|settings| settings.inline_subschemas = true);
    let mut schema = settings.into_generator().into_root_schema_for::<C>();
    let properties = schema.ensure_object().entry("properties").or_insert_with(|| json!({}));
    if let Value::Object(keys) = properties {
        keys.insert(
            SCHEMA.to_owned(),
            json!({"type": "string", "description": "The schema of this file, for editors."}),
        );
        for alias in C::ALIASES {
            keys.insert((*alias).to_owned(), json!({"description": "Another name of a key."}));
        }
    }
    schema.insert("required".to_owned(), json!(C::REQUIRED));
    // An unknown key is probably mistyped.
    schema.insert("additionalProperties".to_owned(), json!(false));
    schema.to_value()
}

/// Reads a regular file. A FIFO would block until another process writes to it, and a device may never end.
///
/// # Errors
/// When it can't be read, or is not a regular file.
pub fn read_file(file: &Path) -> io::Result<String> {
    if !std::fs::metadata(file)?.is_file() {
        return Err(io::Error::other("it is not a regular file"));
    }
    std::fs::read_to_string(file)
}

fn parse<C: Configuration>(file: &Path) -> Result<Parsed<C>, String> {
    let text = read_file(file).map_err(|error| format!("can't be read: {error}"))?;
    if !text.trim_start().starts_with('{') {
        return Err("it is not a JSON object; allowed is {\"KEY\": VALUE, ...}".to_owned());
    }
    let mut json = serde_json::Deserializer::from_str(&text);
    let mut track = serde_path_to_error::Track::new();
    let parsed = C::deserialize(serde_path_to_error::Deserializer::new(&mut json, &mut track));
    let mut config = parsed
        .and_then(|config| json.end().map(|()| config))
        .map_err(|source| {
            let key = one_line(&track.path().to_string());
            let problem = one_line(&source.to_string());
            if key == "." || key == "?" {
                problem
            } else {
                format!("{key}: {problem}")
            }
        })?;
    let given: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).unwrap_or_default();
    if let Some(key) = C::REQUIRED.iter().find(|key| !given.contains_key(**key)) {
        return Err(format!("{key}: it is missing"));
    }
    let values = serde_json::to_value(&config).unwrap_or_default();
    let own = values.as_object().into_iter().flat_map(serde_json::Map::keys);
    let known: Vec<&str> = own.map(String::as_str).chain(C::ALIASES.iter().copied()).collect();
    let unknown = given
        .keys()
        .filter(|key| *key != SCHEMA && !known.contains(&key.as_str()))
        .map(|key| match alike(key, &known) {
            Some(meant) => format!("unknown key {key:?} is ignored; did you mean {meant:?}?"),
            None => format!("unknown key {key:?} is ignored"),
        })
        .collect();
    let warnings = config.complete(file)?;
    Ok(Parsed {
        config,
        warnings,
        unknown,
    })
}

/// The key that is most likely meant by an unknown one.
fn alike<'a>(key: &str, known: &[&'a str]) -> Option<&'a str> {
    // A text of any length would take long to compare.
    let longest = known.iter().map(|one| one.len()).max().unwrap_or_default();
    if key.len() > 2 * longest {
        return None;
    }
    let key = key.to_lowercase();
    let errors = |one: &str| strsim::damerau_levenshtein(&key, &one.to_lowercase());
    let (fewest, best) = known.iter().map(|one| (errors(one), *one)).min()?;
    (fewest <= TYPING_ERRORS.max(key.len() / LETTERS)).then_some(best)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Deserialize, Serialize, JsonSchema)]
    #[serde(rename_all = "camelCase")]
    struct Small {
        load_refresh: f64,
    }

    impl Configuration for Small {
        fn complete(&mut self, _: &Path) -> Result<Vec<String>, String> {
            Ok(Vec::new())
        }
    }

    #[test]
    fn an_unknown_key_is_told_once() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let again = r#""loadRefrsh": 1, "#.repeat(100);
        std::fs::write(file.path(), format!(r#"{{"loadRefresh": 1, {again} "colour": 2}}"#)).unwrap();
        let told = load::<Small>(file.path()).unwrap().unknown;
        let expected = [
            r#"unknown key "colour" is ignored"#,
            r#"unknown key "loadRefrsh" is ignored; did you mean "loadRefresh"?"#,
        ];
        assert_eq!(
            told,
            expected.map(|words| format!("{}: {words}", file.path().display()))
        );
    }
}
