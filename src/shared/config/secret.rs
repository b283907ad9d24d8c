//! Secrets of a configuration. It contains them, or names their files.

use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize, Serializer};

use super::loading::{read_file, require};
use super::value::ExpandedPath;

/// A text that is never printed or logged; output shows `********`. The configuration contains it, or names its file.
#[derive(Clone, Deserialize)]
#[serde(try_from = "WireSecret")]
pub struct Secret {
    text: String,
    file: Option<PathBuf>,
}

#[derive(Deserialize)]
#[serde(
    untagged,
    deny_unknown_fields,
    expecting = "it is neither a text nor {\"file\": PATH}"
)]
enum WireSecret {
    Text(String),
    File { file: ExpandedPath },
}

impl TryFrom<WireSecret> for Secret {
    type Error = String;

    fn try_from(wire: WireSecret) -> Result<Self, String> {
        let ExpandedPath(file) = match wire {
            WireSecret::Text(text) => return Ok(Self { text, file: None }),
            WireSecret::File { file } => file,
        };
        let text = read_file(&file).map_err(|error| format!("{}: can't be read: {error}", file.display()))?;
        Ok(Self {
            text: text.trim_end_matches(['\r', '\n']).to_owned(),
            file: Some(file),
        })
    }
}

impl Secret {
    /// Returns the secret text.
    pub fn reveal(&self) -> &str {
        &self.text
    }

    /// The file that the secret was read from; `None` if the configuration contains it.
    pub fn file(&self) -> Option<&Path> {
        self.file.as_deref()
    }
}

/// Fewest letters of `fleetKey`.
const MIN_FLEET_KEY: usize = 16;

/// Checks the key `fleetKey`: whoever guesses it takes places that are not his.
///
/// # Errors
/// When it is too short.
pub fn check_fleet_key(key: Option<&Secret>) -> Result<(), String> {
    let is_long = key.is_none_or(|key| key.reveal().chars().count() >= MIN_FLEET_KEY);
    require(is_long, "fleetKey", || {
        format!("it is shorter than {MIN_FLEET_KEY} letters; `openssl rand -hex 32` prints a good one")
    })
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
