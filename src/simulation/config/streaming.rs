//! How clients reach the streams of simulations.

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

/// How clients reach the streams of simulations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Streaming {
    /// Each at the port of its Webots.
    #[default]
    Direct,
    /// Through this server, with a token.
    Relay,
}

/// Reads the key `streaming`.
pub fn streaming<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Streaming, D::Error> {
    let value = serde_json::Value::deserialize(deserializer)?;
    let problem = || D::Error::custom(format!("{value} is not allowed; allowed are \"direct\" and \"relay\""));
    Streaming::deserialize(&value).map_err(|_| problem())
}
