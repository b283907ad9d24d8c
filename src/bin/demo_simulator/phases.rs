//! What makes a world slow, as an option of the world. A line of comment below its first one has the options:
//!
//! ```text
//! #VRML_SIM R2025a utf8
//! #demo-simulator: download=0.6 load=1 busy=2@5
//! ```
//!
//! | option | seconds in which |
//! |---|---|
//! | `download` | there is no world yet, and the event loop runs: a client that requests the scene crashes the program |
//! | `load` | the event loop is blocked: nothing is answered, and there is no heartbeat |
//! | `busy` | the event loop is blocked, `@` so long after the world is loaded |
//! | `work` | a processor is busy for each second of simulation: without it, time passes more slowly |

use std::time::Duration;

/// The comment with the options.
const MARK: &str = "#demo-simulator:";

/// The phases of a world.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Phases {
    /// How long assets are downloaded.
    pub(crate) download: Duration,
    /// How long the world is read.
    pub(crate) load: Duration,
    /// How long the program is busy later.
    pub(crate) busy: Option<Busy>,
    /// Processor time that a second of simulation needs.
    pub(crate) work: Duration,
}

/// A time in which a simulation is busy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Busy {
    /// Its length.
    pub(crate) length: Duration,
    /// The time from the end of the load until it begins.
    pub(crate) after: Duration,
}

impl Phases {
    /// Parses the comments at the beginning of a world.
    ///
    /// # Errors
    /// The option that is not valid.
    pub(crate) fn parse(world: &str) -> Result<Self, String> {
        let mut phases = Self::default();
        let comments = world.lines().map_while(|line| line.starts_with('#').then_some(line));
        for option in comments
            .filter_map(|line| line.strip_prefix(MARK))
            .flat_map(str::split_whitespace)
        {
            phases.set(option).ok_or_else(|| option.to_owned())?;
        }
        Ok(phases)
    }

    fn set(&mut self, option: &str) -> Option<()> {
        match option.split_once('=')? {
            ("download", time) => self.download = seconds(time)?,
            ("load", time) => self.load = seconds(time)?,
            ("work", time) => self.work = seconds(time)?,
            ("busy", time) => {
                let (length, after) = time.split_once('@')?;
                self.busy = Some(Busy {
                    length: seconds(length)?,
                    after: seconds(after)?,
                });
            }
            _ => return None,
        }
        Some(())
    }
}

fn seconds(text: &str) -> Option<Duration> {
    Duration::try_from_secs_f64(text.parse().ok()?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_in_comments_at_the_beginning() {
        let header = "#VRML_SIM R2025a utf8\n";
        let phases = |rest: &str| Phases::parse(&format!("{header}{rest}"));
        assert_eq!(
            phases("WorldInfo { }\n#demo-simulator: download=1\n"),
            Ok(Phases::default())
        );
        let expected = Phases {
            download: Duration::from_millis(600),
            load: Duration::from_secs(14),
            busy: Some(Busy {
                length: Duration::from_secs(2),
                after: Duration::from_secs(5),
            }),
            work: Duration::from_millis(50),
        };
        let text =
            "# a comment\n#demo-simulator: download=0.6 load=14\n#demo-simulator: busy=2@5 work=0.05\nWorldInfo { }\n";
        assert_eq!(phases(text), Ok(expected));
        for option in ["load", "load=x", "load=-1", "busy=2", "busy=2@", "fast=1"] {
            assert_eq!(phases(&format!("#demo-simulator: {option}\n")), Err(option.to_owned()));
        }
    }
}
