//! Types of configuration values. The error of an invalid value says what is expected.

use std::borrow::Cow;
use std::env::VarError;
use std::fmt;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use shellexpand::LookupError;

use crate::shared::text::excerpt;

/// Longest excerpt of an invalid value in an error, in characters.
const MAX_SHOWN: usize = 60;

/// A path with `~` and `$VARIABLE` expanded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct ExpandedPath(pub PathBuf);

impl TryFrom<String> for ExpandedPath {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        if text.is_empty() || text.contains('\0') {
            return Err(format!("{text:?} is no path; \".\" is the working folder"));
        }
        shellexpand::full(&text)
            .map(|path| Self(path.into_owned().into()))
            .map_err(|error| not_set(&text, &error))
    }
}

fn not_set(text: &str, error: &LookupError<VarError>) -> String {
    format!(
        "{text:?} names the environment variable {}, which is not set",
        error.var_name
    )
}

/// Expands `$VARIABLE` in a text.
///
/// # Errors
/// When the text names a variable that is not set.
pub fn expand(text: &str) -> Result<String, String> {
    shellexpand::env(text)
        .map(Cow::into_owned)
        .map_err(|error| not_set(text, &error))
}

/// Reads a text and expands `$VARIABLE`.
///
/// # Errors
/// When the value is not a text, or names a variable that is not set.
pub fn expanded<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    expand(&String::deserialize(deserializer)?).map_err(D::Error::custom)
}

/// Whether a text is the URL of a web server.
pub fn is_web_url(text: &str) -> bool {
    url::Url::parse(text).is_ok_and(|url| url.has_host() && matches!(url.scheme(), "http" | "https"))
}

/// Reads a whole number from `MIN` to `MAX`.
///
/// # Errors
/// When the value is something else.
pub fn whole<'de, const MIN: u64, const MAX: u64, T, D>(deserializer: D) -> Result<T, D::Error>
where
    T: TryFrom<u64>,
    D: Deserializer<'de>,
{
    let value = Value::deserialize(deserializer)?;
    let number = value.as_u64().filter(|number| (MIN..=MAX).contains(number));
    let number = number.and_then(|number| T::try_from(number).ok());
    number.ok_or_else(|| not_allowed(&value, format_args!("a whole number from {MIN} to {MAX}")))
}

/// Reads a whole number from `MIN` to `MAX`, or `null`.
///
/// # Errors
/// When the value is something else.
pub fn optional_whole<'de, const MIN: u64, const MAX: u64, T, D>(deserializer: D) -> Result<Option<T>, D::Error>
where
    T: TryFrom<u64>,
    D: Deserializer<'de>,
{
    let value = Option::<Value>::deserialize(deserializer)?;
    value.map(whole::<MIN, MAX, _, _>).transpose().map_err(D::Error::custom)
}

/// Reads a text of one line, from 1 to 200 characters.
///
/// # Errors
/// When the value is something else.
pub fn sentence<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let text = String::deserialize(deserializer)?;
    let is_line = (1..=200).contains(&text.trim().chars().count()) && !text.chars().any(char::is_control);
    is_line.then(|| text.trim().to_owned()).ok_or_else(|| {
        not_allowed(
            &Value::String(text),
            format_args!("a text of one line, of 1 to 200 letters"),
        )
    })
}

/// Reads a percentage from 0 to `MAX`.
///
/// # Errors
/// When the value is something else.
pub fn percent<'de, const MAX: u16, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    between(deserializer, 0.0..=MAX.into(), "percent")
}

/// A duration, written as a number of seconds.
pub mod seconds {
    use super::{Deserializer, Duration, Serializer, between};

    /// Reads a number of seconds from 0.01 to a year.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
        between(deserializer, 0.01..=31_536_000.0, "seconds").map(Duration::from_secs_f64)
    }

    /// Writes the seconds.
    ///
    /// # Errors
    /// When the output fails.
    pub fn serialize<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_f64(duration.as_secs_f64())
    }
}

/// A duration in seconds, or 0 for none.
pub mod seconds_or_zero {
    pub use super::seconds::serialize;
    use super::{Deserializer, Duration, between};

    /// Reads a number of seconds from 0 to a day.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
        between(deserializer, 0.0..=86_400.0, "seconds").map(Duration::from_secs_f64)
    }
}

/// Reads a number of minutes from 0 to a day.
///
/// # Errors
/// When the value is something else.
pub fn minutes<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    between(deserializer, 0.0..=1440.0, "minutes")
}

/// Reads a number of this range.
fn between<'de, D: Deserializer<'de>>(
    deserializer: D,
    range: RangeInclusive<f64>,
    unit: &str,
) -> Result<f64, D::Error> {
    let value = Value::deserialize(deserializer)?;
    let number = value.as_f64().filter(|number| range.contains(number));
    let least = range.start();
    let most = range.end();
    number.ok_or_else(|| not_allowed(&value, format_args!("a number of {unit} from {least} to {most}")))
}

fn not_allowed<E: serde::de::Error>(value: &Value, allowed: fmt::Arguments<'_>) -> E {
    E::custom(format_args!(
        "{} is not allowed; allowed is {allowed}",
        excerpt(&value.to_string(), MAX_SHOWN)
    ))
}

/// Reads a list; a single value is a list of one, and `null` an empty one.
///
/// # Errors
/// When the value is something else.
pub fn one_or_many<'de, T, D>(deserializer: D) -> Result<Vec<T>, D::Error>
where
    T: DeserializeOwned,
    D: Deserializer<'de>,
{
    match Value::deserialize(deserializer)? {
        Value::Null => Ok(Vec::new()),
        many @ Value::Array(_) => serde_json::from_value(many),
        one => serde_json::from_value(one).map(|value| vec![value]),
    }
    .map_err(D::Error::custom)
}
