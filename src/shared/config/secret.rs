//! Secrets of a configuration. It contains them, or names their files.

use std::fmt;
use std::path::{Path, PathBuf};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize, Serializer};

use super::loading::read_file;
use super::value::ExpandedPath;

/// A text that is never printed or logged; output shows `********`. The configuration contains it, or names its file.
#[derive(Clone, Deserialize, JsonSchema)]
#[serde(try_from = "WireSecret")]
pub struct Secret {
    text: String,
    file: Option<PathBuf>,
}

#[derive(Deserialize, JsonSchema)]
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
