//! The key `limits`: what one simulation may take of the machine.

use serde::{Deserialize, Deserializer, Serialize};

use crate::shared::config::whole;

/// What one simulation may take.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct ResourceLimits {
    /// How much of its output is read, in KiB per second; short lines count more. It waits as it prints more. Default: 512.
    #[serde(deserialize_with = "whole::<1, 1_000_000, _, _>")]
    pub output: u64,
    /// How much it may write into its folders beyond its project, in MiB. One that writes more is ended. Default: 1024.
    #[serde(deserialize_with = "whole::<1, 100_000_000, _, _>")]
    pub disk: u64,
    /// How many processes and threads it may have. Default: 4096.
    #[serde(deserialize_with = "whole::<10, 4_000_000, _, _>")]
    pub processes: u64,
    /// How many files each of its processes may have open. Default: 4096.
    #[serde(deserialize_with = "whole::<64, 1_000_000, _, _>")]
    pub open_files: u64,
    /// How much memory it may take, in MiB, where control groups can be had. Default: none.
    #[serde(deserialize_with = "optional")]
    pub memory: Option<u64>,
    /// How many cores it may keep busy, where control groups can be had. Default: none.
    #[serde(deserialize_with = "optional")]
    pub cores: Option<u64>,
}

impl Default for ResourceLimits {
    fn default() -> Self {
        Self { output: 512, disk: 1024, processes: 4096, open_files: 4096, memory: None, cores: None }
    }
}

/// Reads a whole number from 1 to 100 million, or `null`.
fn optional<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u64>, D::Error> {
    /// A number in its range.
    #[derive(Deserialize)]
    struct Number(#[serde(deserialize_with = "whole::<1, 100_000_000, _, _>")] u64);
    Ok(Option::<Number>::deserialize(deserializer)?.map(|number| number.0))
}
