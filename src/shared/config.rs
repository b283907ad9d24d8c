//! Reading configuration files: JSON with camelCase keys.
//!
//! A wrong type, a missing key or a value out of range is one line that names the file, the key, what was found and
//! what is allowed. Unknown keys are warned about, with the nearest known one.

use std::fmt;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::config_error::ConfigError;
use serde::de::{DeserializeOwned, Error as _, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A server's configuration.
pub trait Configuration: DeserializeOwned + Serialize {
    /// Other names of keys, which are accepted too.
    const ALIASES: &'static [&'static str];

    /// What no single value shows: rules between values, defaults that depend on the machine. Gives back warnings.
    ///
    /// # Errors
    /// A key, and what is wrong with it.
    fn complete(&mut self) -> Result<Vec<String>, Unfit>;
}

/// A value that doesn't fit the others.
#[derive(Debug)]
pub struct Unfit {
    /// The key of the value.
    pub key: &'static str,
    /// What was found, and what is allowed.
    pub problem: String,
}

/// A configuration that was read.
#[derive(Debug)]
pub struct Loaded<C> {
    /// The effective values.
    pub config: C,
    /// What the administrator should know.
    pub warnings: Vec<String>,
}

/// Reads a configuration file.
///
/// # Errors
/// When it can't be read, or a value is not allowed.
pub fn load<C: Configuration>(file: &Path) -> Result<Loaded<C>, ConfigError> {
    let text =
        std::fs::read_to_string(file).map_err(|source| ConfigError::Unreadable { file: file.to_owned(), source })?;
    if !text.trim_start().starts_with('{') {
        return Err(ConfigError::NoObject { file: file.to_owned() });
    }
    let mut unknown = Vec::new();
    let mut json = serde_json::Deserializer::from_str(&text);
    let mut track = serde_path_to_error::Track::new();
    let tracked = serde_path_to_error::Deserializer::new(&mut json, &mut track);
    let parsed = serde_ignored::deserialize(tracked, |path| unknown.push(path.to_string()))
        .and_then(|config| json.end().map(|()| config));
    let mut config: C = parsed.map_err(|source| {
        let key = Some(track.path().to_string()).filter(|key| key != "." && key != "?");
        ConfigError::Malformed { file: file.to_owned(), key, source }
    })?;
    let known = known_keys(&config);
    let mut warnings: Vec<String> = unknown.iter().map(|key| unknown_key(file, key, &known)).collect();
    let more = config.complete().map_err(|Unfit { key, problem }| ConfigError::Unfit {
        file: file.to_owned(),
        key,
        problem,
    })?;
    warnings.extend(more.iter().map(|warning| format!("{}: {warning}", file.display())));
    Ok(Loaded { config, warnings })
}

/// Every key that a configuration has, with the keys of its parts as `part.key`.
fn known_keys<C: Configuration>(config: &C) -> Vec<String> {
    let mut keys: Vec<String> = C::ALIASES.iter().map(|&alias| alias.to_owned()).collect();
    let Ok(serde_json::Value::Object(values)) = serde_json::to_value(config) else {
        return keys;
    };
    for (key, value) in values {
        if let serde_json::Value::Object(part) = value {
            keys.extend(part.keys().map(|inner| format!("{key}.{inner}")));
        }
        keys.push(key);
    }
    keys
}

fn unknown_key(file: &Path, key: &str, known: &[String]) -> String {
    let nearest = known
        .iter()
        .map(|candidate| (strsim::normalized_damerau_levenshtein(key, candidate), candidate))
        .filter(|(likeness, _)| *likeness > 0.5)
        .max_by(|(one, _), (other, _)| one.total_cmp(other));
    let hint = nearest.map(|(_, candidate)| format!("; did you mean {candidate:?}?")).unwrap_or_default();
    format!("{}: unknown key {key:?} is ignored{hint}", file.display())
}

/// A path in which `~` and `$VAR` were replaced.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct ExpandedPath(pub PathBuf);

impl ExpandedPath {
    /// A path that needs no replacements.
    #[must_use]
    pub fn plain(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }
}

impl TryFrom<String> for ExpandedPath {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        if text.contains('\0') {
            return Err(format!("{text:?} is no path; it has a NUL in it"));
        }
        match shellexpand::full(&text) {
            Ok(expanded) => Ok(Self(PathBuf::from(expanded.into_owned()))),
            Err(error) => Err(format!("{text:?} names the environment variable {}, which is not set", error.var_name)),
        }
    }
}

/// Reads the path of a folder, which must not be empty.
///
/// # Errors
/// When the value is something else.
pub fn folder<'de, D: Deserializer<'de>>(deserializer: D) -> Result<ExpandedPath, D::Error> {
    let path = ExpandedPath::deserialize(deserializer)?;
    let is_empty = path.0.as_os_str().is_empty();
    if is_empty { Err(D::Error::custom("\"\" is no folder; \".\" is the working folder")) } else { Ok(path) }
}

/// Reads a local address to listen on.
///
/// # Errors
/// When the value is something else.
pub fn local_address<'de, D: Deserializer<'de>>(deserializer: D) -> Result<IpAddr, D::Error> {
    let text = String::deserialize(deserializer)?;
    text.parse().map_err(|_| D::Error::custom(format!("{text:?} is no address; allowed are such as 127.0.0.1 or ::1")))
}

/// A text that is never shown.
#[derive(Clone, Deserialize)]
pub struct Secret(String);

impl Secret {
    /// The text, for the one who needs it.
    #[must_use]
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("********")
    }
}

impl Serialize for Secret {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str("********")
    }
}

/// Reads a whole number from `MIN` to `MAX`, and says so when it is something else.
///
/// # Errors
/// When the value is something else.
pub fn whole<'de, const MIN: u64, const MAX: u64, T, D>(deserializer: D) -> Result<T, D::Error>
where
    T: TryFrom<u64>,
    D: Deserializer<'de>,
{
    struct Whole<const MIN: u64, const MAX: u64>;
    impl<const MIN: u64, const MAX: u64> Visitor<'_> for Whole<MIN, MAX> {
        type Value = u64;

        fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(out, "a whole number from {MIN} to {MAX}")
        }

        fn visit_u64<E: serde::de::Error>(self, number: u64) -> Result<u64, E> {
            if (MIN..=MAX).contains(&number) {
                Ok(number)
            } else {
                Err(E::invalid_value(Unexpected::Unsigned(number), &self))
            }
        }
    }
    let number = deserializer.deserialize_any(Whole::<MIN, MAX>)?;
    T::try_from(number).map_err(|_| D::Error::custom(format!("{number} is too large")))
}

/// Like [`whole`], for a key that may be absent or `null`.
///
/// # Errors
/// When the value is something else.
pub fn optional_port<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u16>, D::Error> {
    #[derive(Deserialize)]
    struct Port(#[serde(deserialize_with = "whole::<1, 65535, _, _>")] u16);
    Ok(Option::<Port>::deserialize(deserializer)?.map(|port| port.0))
}

/// Reads a percentage from 0 to 100.
///
/// # Errors
/// When the value is something else.
pub fn percent<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    deserializer.deserialize_any(Between { least: 0.0, most: 100.0, what: "a number of percent" })
}

/// Reads a percentage that may pass 100, which nothing that is measured does.
///
/// # Errors
/// When the value is something else.
pub fn threshold<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    deserializer.deserialize_any(Between { least: 0.0, most: 1000.0, what: "a number of percent" })
}

/// A duration, written as a number of seconds.
pub mod seconds {
    use super::{Between, Deserializer, Duration, Serializer};

    /// Reads a number of seconds from 0.01 to a year.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
        let year = 31_536_000.0;
        let number = deserializer.deserialize_any(Between { least: 0.01, most: year, what: "a number of seconds" })?;
        Ok(Duration::from_secs_f64(number))
    }

    /// Writes the seconds.
    ///
    /// # Errors
    /// When the output fails.
    pub fn serialize<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_f64(duration.as_secs_f64())
    }
}

/// Reads a number between two others.
struct Between {
    least: f64,
    most: f64,
    what: &'static str,
}

impl Visitor<'_> for Between {
    type Value = f64;

    fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{} from {} to {}", self.what, self.least, self.most)
    }

    fn visit_f64<E: serde::de::Error>(self, number: f64) -> Result<f64, E> {
        if (self.least..=self.most).contains(&number) {
            Ok(number)
        } else {
            Err(E::invalid_value(Unexpected::Float(number), &self))
        }
    }

    fn visit_u64<E: serde::de::Error>(self, number: u64) -> Result<f64, E> {
        #[expect(clippy::cast_precision_loss, reason = "numbers that large are out of range anyway")]
        self.visit_f64(number as f64)
    }
}

/// Reads a list of texts; a single text counts as a list of one.
///
/// # Errors
/// When the value is something else.
pub fn one_or_many<'de, T, D>(deserializer: D) -> Result<Vec<T>, D::Error>
where
    T: DeserializeOwned,
    D: Deserializer<'de>,
{
    match serde_json::Value::deserialize(deserializer)? {
        serde_json::Value::Null => Ok(Vec::new()),
        many @ serde_json::Value::Array(_) => serde_json::from_value(many),
        one => serde_json::from_value(one).map(|value| vec![value]),
    }
    .map_err(D::Error::custom)
}
