//! Reads configuration files: JSON with camelCase keys.
//!
//! An error is one line with the file, the key, what was found and what is expected. An unknown key is a warning with
//! the most similar known key.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::error::ConfigError;
use super::secret::read_file;
use crate::shared::text::one_line;

/// A server's configuration.
pub trait Configuration: DeserializeOwned + Serialize {
    /// Aliases of keys.
    const ALIASES: &'static [&'static str];
    /// Keys that must be there.
    const REQUIRED: &'static [&'static str] = &[];

    /// Sets the values that depend on the machine and on the configuration file, and checks the rules between values.
    /// Returns warnings.
    ///
    /// # Errors
    /// When a value contradicts others.
    fn complete(&mut self, file: &Path) -> Result<Vec<String>, InvalidValueError>;
}

/// A value that contradicts others.
#[derive(Debug)]
pub struct InvalidValueError {
    /// The key of the value.
    pub key: &'static str,
    /// What was found, and what is expected.
    pub problem: String,
}

/// Checks a rule for the value of a key; `problem` says what was found, and what is expected.
///
/// # Errors
/// When the rule does not hold.
pub fn require(holds: bool, key: &'static str, problem: impl FnOnce() -> String) -> Result<(), InvalidValueError> {
    if holds { Ok(()) } else { Err(InvalidValueError { key, problem: problem() }) }
}

/// A configuration that was read from a file.
#[derive(Debug)]
pub struct LoadedConfig<C> {
    /// The effective values.
    pub config: C,
    /// Warnings for the administrator, one line each.
    pub warnings: Vec<String>,
}

/// Reads a configuration file.
///
/// # Errors
/// When the file can't be read, or a value is not allowed.
pub fn load<C: Configuration>(file: &Path) -> Result<LoadedConfig<C>, ConfigError> {
    let wrong = |problem| ConfigError { file: file.to_owned(), problem };
    let text = read_file(file).map_err(|error| wrong(format!("can't be read: {error}")))?;
    // Some editors begin a file with a byte order mark.
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    if !text.trim_start().starts_with('{') {
        return Err(wrong("it is not a JSON object; allowed is {\"KEY\": VALUE, ...}".to_owned()));
    }
    let mut unknown = Vec::new();
    let mut seen = BTreeSet::new();
    let mut json = serde_json::Deserializer::from_str(text);
    let mut track = serde_path_to_error::Track::new();
    let tracked = serde_path_to_error::Deserializer::new(&mut json, &mut track);
    let parsed = serde_ignored::deserialize(tracked, |path| unknown.push(path.to_string()))
        .and_then(|config| json.end().map(|()| config));
    let mut config: C = parsed.map_err(|source| {
        let key = one_line(&track.path().to_string());
        let problem = one_line(&source.to_string());
        wrong(if key == "." || key == "?" { problem } else { format!("{key}: {problem}") })
    })?;
    let given: serde_json::Map<String, serde_json::Value> = serde_json::from_str(text).unwrap_or_default();
    if let Some(key) = C::REQUIRED.iter().find(|key| !given.contains_key(**key)) {
        return Err(wrong(format!("{key}: it is missing")));
    }
    // A repeated key is reported once.
    unknown.retain(|key: &String| seen.insert(key.clone()));
    let known = known_keys(&config);
    let mut warnings: Vec<String> = unknown.iter().map(|key| unknown_key(file, key, &known)).collect();
    let more =
        config.complete(file).map_err(|InvalidValueError { key, problem }| wrong(format!("{key}: {problem}")))?;
    warnings.extend(more.iter().map(|warning| format!("{}: {warning}", file.display())));
    Ok(LoadedConfig { config, warnings })
}

/// Returns all values of a configuration; nested ones under `part.key`.
fn flat_values<C: Serialize>(config: &C) -> BTreeMap<String, serde_json::Value> {
    let values = serde_json::to_value(config).unwrap_or_default();
    let mut flat = BTreeMap::new();
    for (key, value) in values.as_object().into_iter().flatten() {
        match value {
            serde_json::Value::Object(part) => {
                flat.extend(part.iter().map(|(inner, value)| (format!("{key}.{inner}"), value.clone())));
            }
            value => drop(flat.insert(key.clone(), value.clone())),
        }
    }
    flat
}

/// Returns every key of a configuration, and those of its parts as `part.key`.
fn known_keys<C: Configuration>(config: &C) -> Vec<String> {
    let parts = serde_json::to_value(config).unwrap_or_default();
    let parts = parts.as_object().into_iter().flat_map(|values| values.keys().cloned().collect::<Vec<_>>());
    let aliases = C::ALIASES.iter().map(|&alias| alias.to_owned());
    aliases.chain(flat_values(config).into_keys()).chain(parts).collect()
}

/// The warning about an unknown key, with the most similar known one.
fn unknown_key(file: &Path, key: &str, known: &[String]) -> String {
    let nearest = known
        .iter()
        .map(|candidate| (strsim::normalized_damerau_levenshtein(key, candidate), candidate))
        .filter(|(similarity, _)| *similarity > 0.5)
        .max_by(|(one, _), (other, _)| one.total_cmp(other));
    let hint = nearest.map(|(_, candidate)| format!("; did you mean {candidate:?}?")).unwrap_or_default();
    format!("{}: unknown key {key:?} is ignored{hint}", file.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Deserialize, Serialize)]
    #[serde(rename_all = "camelCase")]
    struct Small {
        load_refresh: f64,
    }

    impl Configuration for Small {
        const ALIASES: &'static [&'static str] = &[];

        fn complete(&mut self, _: &Path) -> Result<Vec<String>, InvalidValueError> {
            Ok(Vec::new())
        }
    }

    #[test]
    fn an_unknown_key_is_told_once_with_the_most_similar_one() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let again = r#""loadRefrsh": 1, "#.repeat(100);
        std::fs::write(file.path(), format!(r#"{{"loadRefresh": 1, {again} "colour": 2}}"#)).unwrap();
        let told = load::<Small>(file.path()).unwrap().warnings;
        let expected = [
            r#"unknown key "loadRefrsh" is ignored; did you mean "loadRefresh"?"#,
            r#"unknown key "colour" is ignored"#,
        ];
        assert_eq!(told, expected.map(|words| format!("{}: {words}", file.path().display())));
    }
}
