//! Types of configuration values. The error of an invalid value says what is expected.

use std::borrow::Cow;
use std::env::VarError;
use std::fmt;
use std::marker::PhantomData;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use shellexpand::LookupError;

use crate::shared::text::excerpt;

/// Longest excerpt of an invalid value in an error, in characters.
const MAX_SHOWN: usize = 60;

/// A path with `~` and `$VARIABLE` expanded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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

/// Whether a text is the URL of a web server.
pub fn is_web_url(text: &str) -> bool {
    url::Url::parse(text).is_ok_and(|url| url.has_host() && matches!(url.scheme(), "http" | "https"))
}

/// Defines kinds of values: how each is read (the error of an invalid value says what is allowed), and its JSON schema.
/// They are written as they are.
macro_rules! kinds {
    ($(
        $(#[$doc:meta])*
        $name:ident$(<$(const $bound:ident: $number:ty),+>)? = $schema:expr;
    )+) => {$(
        $(#[$doc])*
        pub struct $name$(<$(const $bound: $number),+>)?;

        impl$(<$(const $bound: $number),+>)? $name$(<$($bound),+>)? {
            /// Writes the value.
            ///
            /// # Errors
            /// When the output fails.
            pub fn serialize<T: Serialize, S: Serializer>(value: &T, serializer: S) -> Result<S::Ok, S::Error> {
                value.serialize(serializer)
            }
        }

        impl$(<$(const $bound: $number),+>)? JsonSchema for $name$(<$($bound),+>)? {
            fn inline_schema() -> bool {
                true
            }

            fn schema_name() -> Cow<'static, str> {
                stringify!($name).into()
            }

            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                $schema
            }
        }
    )+};
}

kinds! {
    /// A text in which `$VARIABLE` is expanded.
    Expanded = json_schema!({"type": "string"});
    /// A text of one line, from 1 to 200 characters.
    Sentence = json_schema!({"type": "string", "minLength": 1, "maxLength": MAX_SENTENCE});
    /// A whole number from `MIN` to `MAX`.
    Whole<const MIN: u64, const MAX: u64> = json_schema!({"type": "integer", "minimum": MIN, "maximum": MAX});
    /// A whole number from `MIN` to `MAX`, or `null`.
    OptionalWhole<const MIN: u64, const MAX: u64> =
        json_schema!({"type": ["integer", "null"], "minimum": MIN, "maximum": MAX});
    /// A percentage from 0 to `MAX`.
    Percent<const MAX: u16> = json_schema!({"type": "number", "minimum": 0, "maximum": MAX});
    /// A share from 0 to 1.
    Share = json_schema!({"type": "number", "minimum": 0, "maximum": 1});
    /// A number of minutes from 0 to a day.
    Minutes = json_schema!({"type": "number", "minimum": 0, "maximum": DAY_IN_MINUTES});
}

/// A duration, written as a number of seconds from 0.01 to a year.
pub struct Seconds;

/// A duration, written as a number of seconds from 0 to a day; 0 for none.
pub struct SecondsOrZero;

/// A list; a single value is a list of one, and `null` an empty one.
pub struct OneOrMany<T>(PhantomData<T>);

/// Longest text of one line, in characters.
const MAX_SENTENCE: usize = 200;
/// The shortest duration, and the longest, in seconds.
const SHORTEST: f64 = 0.01;
const YEAR: f64 = 31_536_000.0;
const DAY: f64 = 86_400.0;
const DAY_IN_MINUTES: f64 = 1440.0;

impl Expanded {
    /// Reads a text, and expands it.
    ///
    /// # Errors
    /// When the value is not a text, or names a variable that is not set.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
        expand(&String::deserialize(deserializer)?).map_err(D::Error::custom)
    }
}

impl Sentence {
    /// Reads the text.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
        let text = String::deserialize(deserializer)?;
        let is_line = (1..=MAX_SENTENCE).contains(&text.trim().chars().count()) && !text.chars().any(char::is_control);
        is_line.then(|| text.trim().to_owned()).ok_or_else(|| {
            not_allowed(
                &Value::String(text),
                format_args!("a text of one line, of 1 to {MAX_SENTENCE} letters"),
            )
        })
    }
}

impl<const MIN: u64, const MAX: u64> Whole<MIN, MAX> {
    /// Reads the number.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, T: TryFrom<u64>, D: Deserializer<'de>>(deserializer: D) -> Result<T, D::Error> {
        let value = Value::deserialize(deserializer)?;
        let number = value.as_u64().filter(|number| (MIN..=MAX).contains(number));
        let number = number.and_then(|number| T::try_from(number).ok());
        number.ok_or_else(|| not_allowed(&value, format_args!("a whole number from {MIN} to {MAX}")))
    }
}

impl<const MIN: u64, const MAX: u64> OptionalWhole<MIN, MAX> {
    /// Reads the number, or `null`.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, T: TryFrom<u64>, D: Deserializer<'de>>(deserializer: D) -> Result<Option<T>, D::Error> {
        let value = Option::<Value>::deserialize(deserializer)?;
        value
            .map(Whole::<MIN, MAX>::deserialize::<T, _>)
            .transpose()
            .map_err(D::Error::custom)
    }
}

impl<const MAX: u16> Percent<MAX> {
    /// Reads the percentage.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        between(deserializer, 0.0..=MAX.into(), "percent")
    }
}

impl Share {
    /// Reads the share.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        let value = Value::deserialize(deserializer)?;
        let number = value.as_f64().filter(|number| (0.0..=1.0).contains(number));
        number.ok_or_else(|| not_allowed(&value, format_args!("a number from 0 to 1")))
    }
}

impl Minutes {
    /// Reads the minutes.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        between(deserializer, 0.0..=DAY_IN_MINUTES, "minutes")
    }
}

/// Implements a kind of durations.
macro_rules! durations {
    ($($name:ident = $least:expr, $most:expr;)+) => {$(
        impl $name {
            /// Reads the seconds.
            ///
            /// # Errors
            /// When the value is something else.
            pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
                between(deserializer, $least..=$most, "seconds").map(Duration::from_secs_f64)
            }

            /// Writes the seconds.
            ///
            /// # Errors
            /// When the output fails.
            pub fn serialize<S: Serializer>(duration: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.serialize_f64(duration.as_secs_f64())
            }
        }

        impl JsonSchema for $name {
            fn inline_schema() -> bool {
                true
            }

            fn schema_name() -> Cow<'static, str> {
                stringify!($name).into()
            }

            fn json_schema(_: &mut SchemaGenerator) -> Schema {
                json_schema!({"type": "number", "minimum": $least, "maximum": $most})
            }
        }
    )+};
}

durations! {
    Seconds = SHORTEST, YEAR;
    SecondsOrZero = 0.0, DAY;
}

impl<T: DeserializeOwned> OneOrMany<T> {
    /// Reads the list.
    ///
    /// # Errors
    /// When the value is something else.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
        match Value::deserialize(deserializer)? {
            Value::Null => Ok(Vec::new()),
            many @ Value::Array(_) => serde_json::from_value(many),
            one => serde_json::from_value(one).map(|value| vec![value]),
        }
        .map_err(D::Error::custom)
    }

    /// Writes the list.
    ///
    /// # Errors
    /// When the output fails.
    pub fn serialize<S: Serializer>(values: &[T], serializer: S) -> Result<S::Ok, S::Error>
    where
        T: Serialize,
    {
        values.serialize(serializer)
    }
}

impl<T: JsonSchema> JsonSchema for OneOrMany<T> {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        format!("OneOrMany{}", T::schema_name()).into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let one = generator.subschema_for::<T>();
        json_schema!({"anyOf": [{"type": "array", "items": one}, one, {"type": "null"}]})
    }
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
