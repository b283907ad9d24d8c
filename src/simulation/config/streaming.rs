//! How clients reach the streams of simulations.

use serde::{Deserialize, Serialize};

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
