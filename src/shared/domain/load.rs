//! The load of a machine.

use std::fmt;

use serde::{Deserialize, Serialize};

/// A machine's load in percent: finite and not negative. It may exceed 100.
#[derive(Debug, Clone, Copy, Default, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64")]
pub struct Load(f64);

impl Load {
    /// The load of an idle machine.
    pub const ZERO: Self = Self(0.0);
    /// The least load that a machine without a free slot tells those who know only loads.
    pub const NO_SLOT: Self = Self(99.0);
    /// The load of a machine that accepts no more clients.
    pub const FULL: Self = Self(100.0);

    /// The load as a number of percent.
    pub fn percent(self) -> f64 {
        self.0
    }

    /// The mean of loads; `None` if there are none.
    pub fn mean(loads: impl Iterator<Item = Self>) -> Option<Self> {
        let (sum, count) = loads.fold((0.0, 0_u32), |(sum, count), load| (sum + load.0, count + 1));
        (count > 0).then(|| Self(sum / f64::from(count)))
    }

    /// Reads the body of a `/load` answer: a plain decimal number.
    ///
    /// # Errors
    /// When the body is anything else.
    pub fn parse(body: &[u8]) -> Result<Self, String> {
        let text = String::from_utf8_lossy(body);
        Self::try_from(
            text.trim()
                .parse::<f64>()
                .map_err(|_| no_load(format_args!("{:?}", text.trim())))?,
        )
    }
}

impl TryFrom<f64> for Load {
    type Error = String;

    fn try_from(number: f64) -> Result<Self, String> {
        if number.is_finite() && number >= 0.0 {
            Ok(Self(number))
        } else {
            Err(no_load(number))
        }
    }
}

fn no_load(what: impl fmt::Display) -> String {
    format!("{what} is no load; a load is a finite number of percent that is not negative")
}

impl fmt::Display for Load {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, out)
    }
}
