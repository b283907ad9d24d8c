//! One run of the server: a process. Several run at a time while older ones serve their last clients.

use std::fmt;
use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

/// A process of this server: a random number, which names its directory, and which its tokens and passes contain. So a
/// request for one of its simulations shows whose it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct RunId(u32);

static OWN: LazyLock<RunId> = LazyLock::new(|| RunId(rand::random()));

/// The beginning of the names of directories.
const PREFIX: &str = "run-";

impl RunId {
    /// This process.
    pub fn own() -> Self {
        *OWN
    }

    /// A random number that names this process.
    pub fn number() -> u64 {
        u64::from(Self::own().0) << u32::BITS | u64::from(rand::random::<u32>())
    }

    /// The process that such a number names.
    pub fn of(number: u64) -> Self {
        Self(u32::try_from(number >> u32::BITS).unwrap_or_default())
    }

    /// The name of its directory.
    pub fn folder(self) -> String {
        format!("{PREFIX}{self}")
    }

    /// The process with this directory.
    pub fn with_folder(name: &str) -> Option<Self> {
        u32::from_str_radix(name.strip_prefix(PREFIX)?, 16).ok().map(Self)
    }
}

impl fmt::Display for RunId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{:08x}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_and_a_folder_name_the_run() {
        let own = RunId::own();
        assert_eq!(RunId::of(RunId::number()), own);
        assert_ne!(RunId::number(), RunId::number());
        assert_eq!(RunId::with_folder(&own.folder()), Some(own));
        for other in ["", "run-", "run-x", "0123abcd", "run-123456789"] {
            assert_eq!(RunId::with_folder(other), None, "{other:?}");
        }
    }
}
