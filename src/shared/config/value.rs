//! How values of a configuration are read: a value that is not allowed is told with what is.

use std::fmt;
use std::marker::PhantomData;
use std::net::IpAddr;
use std::path::PathBuf;
use std::time::Duration;

use serde::de::value::MapAccessDeserializer;
use serde::de::{DeserializeOwned, Error as _, MapAccess, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

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

/// Reads a part that is an object. By itself serde takes a list for one too, and its values for those of the first keys.
///
/// # Errors
/// When the value is something else.
pub fn object<'de, T: Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<T, D::Error> {
    struct Object<T>(PhantomData<T>);
    impl<'de, T: Deserialize<'de>> Visitor<'de> for Object<T> {
        type Value = T;

        fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
            out.write_str("an object: {\"KEY\": VALUE, ...}")
        }

        fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<T, A::Error> {
            T::deserialize(MapAccessDeserializer::new(map))
        }
    }
    deserializer.deserialize_map(Object(PhantomData))
}

/// Like [`object`], for a part that may be `null`.
///
/// # Errors
/// When the value is something else.
pub fn optional_object<'de, T: DeserializeOwned, D: Deserializer<'de>>(deserializer: D) -> Result<Option<T>, D::Error> {
    #[derive(Deserialize)]
    #[serde(bound = "T: DeserializeOwned")]
    struct Part<T>(#[serde(deserialize_with = "object")] T);
    Ok(Option::<Part<T>>::deserialize(deserializer)?.map(|part| part.0))
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
