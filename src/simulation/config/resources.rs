//! The keys `limits`, `gpus` and `realTime`: the resources that one simulation may use, and what it is to get.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::config::keys::keys;
use crate::shared::config::{OptionalWhole, Share, Whole};

keys! {
/// The resource limits of one simulation.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct ResourceLimits {
    /// Output that is read, in KiB per second; short lines count more. A simulation that prints more is blocked.
    /// Default: 512.
    #[serde(with = "Whole::<1, 1_000_000>")]
    pub output: u64 = 512,
    /// Space that it may use in its directories beyond its project, in MiB. If it exceeds that, it is ended. Default:
    /// 1024.
    #[serde(with = "Whole::<1, 100_000_000>")]
    pub disk: u64 = 1024,
    /// Limit of its processes and threads. Default: 4096.
    #[serde(with = "Whole::<10, 4_000_000>")]
    pub processes: u64 = 4096,
    /// Limit of open files for each of its processes. Default: 4096.
    #[serde(with = "Whole::<64, 1_000_000>")]
    pub open_files: u64 = 4096,
    /// Memory limit in MiB, if control groups are available. Default: none.
    #[serde(with = "OptionalWhole::<1, 100_000_000>")]
    pub memory: Option<u64> = None,
    /// Limit of busy cores, if control groups are available. Default: none.
    #[serde(with = "OptionalWhole::<1, 100_000_000>")]
    pub cores: Option<u64> = None,
}
}

keys! {
/// What is promised of the speed of simulations.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct RealTime {
    /// The share of real time that simulations are to keep: while they are slower than they can be, no more clients are
    /// offered places. Only with `"streaming": "relay"`; 0: places do not depend on it. Default: 0.9.
    #[serde(with = "Share")]
    pub target: f64 = 0.9,
}
}

/// Which GPU a simulation gets, of several.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum GpuUse {
    /// The first, which drivers choose by themselves; containers get all.
    #[default]
    First,
    /// The one with the least load when it starts.
    Spread,
}
