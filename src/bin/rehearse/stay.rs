//! Times of the command line. Pure.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

/// Longest time of an argument: 30 days.
const LONGEST: Duration = Duration::from_hours(30 * 24);

/// How long clients stay: between these times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Stay {
    pub(crate) least: Duration,
    pub(crate) most: Duration,
}

impl FromStr for Stay {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (least, most) = text.split_once("..").unwrap_or((text, text));
        let stay = Self {
            least: time(least)?,
            most: time(most)?,
        };
        if stay.least <= stay.most {
            Ok(stay)
        } else {
            Err("the first time is the longer one".to_owned())
        }
    }
}

impl fmt::Display for Stay {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}", humantime::format_duration(self.least))?;
        if self.least < self.most {
            write!(out, " to {}", humantime::format_duration(self.most))?;
        }
        Ok(())
    }
}

/// Reads a time.
///
/// # Errors
/// When it is none, or too long.
pub(crate) fn time(text: &str) -> Result<Duration, String> {
    let time = humantime::parse_duration(text).map_err(|error| error.to_string())?;
    if time <= LONGEST {
        Ok(time)
    } else {
        Err("allowed is up to 30d".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stay_is_a_time_or_two() {
        for (text, shown) in [("5s..15s", "5s to 15s"), ("2m", "2m"), ("1s..1s", "1s")] {
            assert_eq!(text.parse::<Stay>().map(|stay| stay.to_string()), Ok(shown.to_owned()));
        }
        for wrong in ["", "5", "5s..", "15s..5s", "a..b", "40d"] {
            assert!(wrong.parse::<Stay>().is_err(), "{wrong}");
        }
    }
}
