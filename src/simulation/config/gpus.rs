//! The key `gpus`: which GPU a simulation gets.

use serde::{Deserialize, Serialize};

/// Which GPU a simulation gets, of several.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GpuUse {
    /// What drivers choose, which is the first; containers get all.
    #[default]
    First,
    /// The one with the least load when it starts.
    Spread,
}
