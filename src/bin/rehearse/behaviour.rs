//! The behaviours of clients, good and bad. Pure.

use std::str::FromStr;
use std::time::Duration;

use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use serde::Serialize;

use crate::stay::Stay;

/// How one client behaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Behaviour {
    /// Watches its simulation and closes its page.
    Ordinary,
    /// Reloads its page in the middle, and starts again.
    Reload,
    /// Reloads its page in the middle, and resumes its simulation.
    Return,
    /// Leaves without closing its connections, as a browser that crashes.
    Drop,
    /// Reads nothing in the second half, as a sleeping tab.
    Sleep,
    /// Neither reads nor closes from the middle on, as a broken network.
    Vanish,
    /// Leaves as soon as it has requested its simulation.
    Hasty,
}

/// Shares of behaviours, in percent; the rest to 100 is ordinary.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Mix(Vec<(Behaviour, u32)>);

const NAMES: [(&str, Behaviour); 6] = [
    ("reload", Behaviour::Reload),
    ("return", Behaviour::Return),
    ("drop", Behaviour::Drop),
    ("sleep", Behaviour::Sleep),
    ("vanish", Behaviour::Vanish),
    ("hasty", Behaviour::Hasty),
];

impl FromStr for Mix {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = |part: &str| format!("{part:?} is no share; allowed is NAME=PERCENT of {}", names());
        let shares = text.split(',').filter(|part| !part.is_empty()).map(|part| {
            let (name, percent) = part.split_once('=').ok_or_else(|| wrong(part))?;
            let (_, behaviour) = NAMES
                .iter()
                .find(|(known, _)| *known == name)
                .ok_or_else(|| wrong(part))?;
            Ok((*behaviour, percent.parse().map_err(|_| wrong(part))?))
        });
        let mix = Self(shares.collect::<Result<_, String>>()?);
        let sum = mix
            .0
            .iter()
            .fold(0_u32, |sum, (_, percent)| sum.saturating_add(*percent));
        if sum <= 100 {
            Ok(mix)
        } else {
            Err(format!("the shares are {sum} percent; allowed is up to 100"))
        }
    }
}

fn names() -> String {
    NAMES.map(|(name, _)| name).join(", ")
}

/// Draws behaviours by their shares; the sequence is the same in each rehearsal.
pub(crate) struct Draw {
    mix: Mix,
    random: SmallRng,
}

impl Draw {
    /// Draws from a mix.
    pub(crate) fn new(mix: Mix) -> Self {
        Self {
            mix,
            random: SmallRng::seed_from_u64(1),
        }
    }

    /// How long the next client stays.
    pub(crate) fn stay(&mut self, stay: Stay) -> Duration {
        self.random.random_range(stay.least..=stay.most)
    }

    /// The behaviour of the next client.
    pub(crate) fn next(&mut self) -> Behaviour {
        let mut number = self.random.random_range(0..100_u32);
        for (behaviour, percent) in &self.mix.0 {
            match number.checked_sub(*percent) {
                Some(rest) => number = rest,
                None => return *behaviour,
            }
        }
        Behaviour::Ordinary
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_drawn_as_they_are_set() {
        let mut draw = Draw::new("reload=20,vanish=30".parse().unwrap());
        let drawn: Vec<Behaviour> = std::iter::repeat_with(|| draw.next()).take(10_000).collect();
        let percent = |wanted| drawn.iter().filter(|one| **one == wanted).count() / 100;
        for (behaviour, share) in [
            (Behaviour::Reload, 20),
            (Behaviour::Vanish, 30),
            (Behaviour::Ordinary, 50),
        ] {
            assert!(
                percent(behaviour).abs_diff(share) <= 2,
                "{behaviour:?}: {}",
                percent(behaviour)
            );
        }
        assert_eq!(percent(Behaviour::Hasty), 0);
    }

    #[test]
    fn a_stay_is_drawn_between_its_times() {
        let mut draw = Draw::new(Mix::default());
        let mut drawn = |stay: &str| -> Vec<Duration> {
            let stay = stay.parse().unwrap();
            std::iter::repeat_with(|| draw.stay(stay)).take(1000).collect()
        };
        let at = |seconds| Duration::from_secs(seconds);
        let all = drawn("5s..15s");
        assert!(all.iter().all(|time| (at(5)..=at(15)).contains(time)));
        assert!(all.iter().any(|time| *time < at(6)) && all.iter().any(|time| *time > at(14)));
        assert!(drawn("2m").iter().all(|time| *time == at(120)));
    }

    #[test]
    fn what_is_no_share_is_told() {
        for wrong in ["reload", "reload=x", "dance=5", "reload=60,drop=41", "reload=-1"] {
            assert!(wrong.parse::<Mix>().is_err(), "{wrong}");
        }
        assert_eq!("".parse::<Mix>(), Ok(Mix::default()));
    }
}
