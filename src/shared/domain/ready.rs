//! Worlds whose simulations are kept ready before clients ask for them: which, how many, and when. Pure.
//!
//! The configuration of either server lists them as [`ReadyEntry`]. A session server sends each simulation server its
//! share as [`KeepReady`]; a simulation server reports what it has as [`ReadyStatus`].

use std::str::FromStr;

use jiff::civil::{Date, DateTime, Time, Weekday};
use jiff::tz::TimeZone;
use jiff::{Timestamp, ToSpan};
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

use super::project_url::ProjectUrl;
use crate::shared::config::{OneOrMany, Whole};

/// How a simulation is shown: Webots is started for one of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(with = "String")]
pub enum View {
    /// A 3D scene that the browser renders, in both spellings of the protocol.
    #[default]
    #[serde(alias = "w3d")]
    X3d,
    /// A video.
    Mjpeg,
}

/// A world to keep ready, as an entry of the key `ready`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct ReadyEntry {
    /// The world.
    pub world: ProjectUrl,
    /// Number of simulations that are kept ready; 0: only its repository stays in the cache.
    #[serde(with = "Whole::<0, 10_000>")]
    pub count: u32,
    /// When: `always`, or times of the week. Default: always.
    #[serde(default = "always", with = "OneOrMany::<When>")]
    pub when: Vec<When>,
    /// The time zone of `when`, `from` and `until`, such as `Europe/Zurich`. Default: that of the machine.
    #[serde(default)]
    pub time_zone: Option<Zone>,
    /// When it begins: a date, or a date and time. Default: at once.
    #[serde(default)]
    pub from: Option<Moment>,
    /// When it ends: a date, which is the last day, or a date and time. Default: never.
    #[serde(default)]
    pub until: Option<Moment>,
    /// How it is shown. Default: `x3d`.
    #[serde(default)]
    pub mode: View,
}

fn always() -> Vec<When> {
    vec![When(WhenKind::Always)]
}

impl ReadyEntry {
    /// Whether it is to be kept ready at this time.
    pub fn is_due(&self, now: Timestamp) -> bool {
        let zone = self
            .time_zone
            .as_ref()
            .map_or_else(TimeZone::system, |zone| zone.zone.clone());
        let begun = self
            .from
            .as_ref()
            .is_none_or(|from| from.begin(&zone).is_some_and(|begin| begin <= now));
        let local = zone.to_datetime(now);
        begun && !self.is_over(now) && self.when.iter().any(|when| when.contains(local))
    }

    /// Whether it will never be due again.
    pub fn is_over(&self, now: Timestamp) -> bool {
        let zone = self
            .time_zone
            .as_ref()
            .map_or_else(TimeZone::system, |zone| zone.zone.clone());
        self.until
            .as_ref()
            .is_some_and(|until| until.end(&zone).is_none_or(|end| end <= now))
    }
}

/// One of the times of an entry, as text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct When(WhenKind);

#[derive(Debug, Clone, PartialEq, Eq)]
enum WhenKind {
    Always,
    /// On these days of the week, from Monday on, in these minutes of the day.
    Week {
        text: String,
        days: [bool; 7],
        from: u16,
        to: u16,
    },
}

/// The names of the days, in the order of the week.
const DAYS: [&str; 7] = ["Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun"];
/// Minutes of a day.
const DAY: u16 = 24 * 60;

impl When {
    fn contains(&self, local: DateTime) -> bool {
        match &self.0 {
            WhenKind::Always => true,
            WhenKind::Week { days, from, to, .. } => {
                let minute = minute_of(local.time());
                days.get(day_of(local.weekday())) == Some(&true) && (*from..*to).contains(&minute)
            }
        }
    }

    fn parse(text: &str) -> Option<WhenKind> {
        if text == "always" {
            return Some(WhenKind::Always);
        }
        let (of_days, of_time) = text.split_once(' ')?;
        let mut days = [false; 7];
        let day = |name: &str| DAYS.iter().position(|known| known.eq_ignore_ascii_case(name));
        for part in of_days.split(',') {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let (first, last) = (day(first)?, day(last)?);
            days.get_mut(first..=last).filter(|days| !days.is_empty())?.fill(true);
        }
        let (from, to) = of_time.trim().split_once('-')?;
        let (from, to) = (minutes(from)?, minutes(to)?);
        (from < to).then(|| WhenKind::Week {
            text: text.to_owned(),
            days,
            from,
            to,
        })
    }
}

fn day_of(day: Weekday) -> usize {
    usize::try_from(day.to_monday_zero_offset()).unwrap_or_default()
}

fn minute_of(time: Time) -> u16 {
    u16::try_from(i16::from(time.hour()) * 60 + i16::from(time.minute())).unwrap_or_default()
}

/// The minute of the day of `HH:MM`; `24:00` is its end.
fn minutes(text: &str) -> Option<u16> {
    let (hours, minutes) = text.split_once(':').filter(|(_, minutes)| minutes.len() == 2)?;
    let (hours, minutes): (u16, u16) = (hours.parse().ok()?, minutes.parse().ok()?);
    let minute = hours.checked_mul(60)?.checked_add(minutes)?;
    (minutes < 60 && minute <= DAY).then_some(minute)
}

impl TryFrom<String> for When {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let wrong = || {
            format!(
                "{text:?} is no time of the week; allowed are \"always\" and such as \"Mon-Fri 07:50-12:00\" or \
                 \"Mon,Wed 13:00-24:00\", from the earlier to the later"
            )
        };
        Self::parse(text.trim()).map(Self).ok_or_else(wrong)
    }
}

impl From<When> for String {
    fn from(when: When) -> Self {
        match when.0 {
            WhenKind::Always => "always".to_owned(),
            WhenKind::Week { text, .. } => text,
        }
    }
}

/// A time zone, by its name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct Zone {
    name: String,
    zone: TimeZone,
}

impl TryFrom<String> for Zone {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        match TimeZone::get(&name) {
            Ok(zone) => Ok(Self { name, zone }),
            Err(_) => Err(format!(
                "{name:?} is no time zone; allowed are names such as \"Europe/Zurich\" or \"UTC\""
            )),
        }
    }
}

impl From<Zone> for String {
    fn from(zone: Zone) -> Self {
        zone.name
    }
}

/// A date, or a date and time, as text.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct Moment {
    text: String,
    kind: MomentKind,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum MomentKind {
    /// With an offset from UTC.
    Exact(Timestamp),
    /// In the time zone of the entry.
    Local(DateTime),
    /// A whole day.
    Day(Date),
}

impl Moment {
    /// Its first instant.
    fn begin(&self, zone: &TimeZone) -> Option<Timestamp> {
        match self.kind {
            MomentKind::Exact(at) => Some(at),
            MomentKind::Local(at) => zone.to_timestamp(at).ok(),
            MomentKind::Day(day) => zone.to_timestamp(day.to_datetime(Time::midnight())).ok(),
        }
    }

    /// The first instant after it.
    fn end(&self, zone: &TimeZone) -> Option<Timestamp> {
        match self.kind {
            MomentKind::Day(day) => {
                let next = day.checked_add(1.day()).ok()?;
                zone.to_timestamp(next.to_datetime(Time::midnight())).ok()
            }
            MomentKind::Exact(_) | MomentKind::Local(_) => self.begin(zone),
        }
    }
}

impl TryFrom<String> for Moment {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let kind = if let Ok(at) = Timestamp::from_str(&text) {
            Some(MomentKind::Exact(at))
        } else if text.contains(':') {
            DateTime::from_str(&text).ok().map(MomentKind::Local)
        } else {
            Date::from_str(&text).ok().map(MomentKind::Day)
        };
        match kind {
            Some(kind) => Ok(Self { text, kind }),
            None => Err(format!(
                "{text:?} is no date; allowed are such as \"2026-12-24\", \"2026-12-24T09:30\" or \
                 \"2026-12-24T09:30:00+01:00\""
            )),
        }
    }
}

impl From<Moment> for String {
    fn from(moment: Moment) -> Self {
        moment.text
    }
}

/// A number of simulations of a world.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct ReadyCount {
    /// The world.
    pub world: ProjectUrl,
    /// How it is shown.
    #[serde(default)]
    pub mode: View,
    /// How many. 0: none now, but its repository stays in the cache.
    pub count: u32,
}

/// The message in which a session server asks a simulation server to keep simulations ready, and no others.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct KeepReady {
    /// How many of each world.
    pub keep_ready: Vec<ReadyCount>,
}

/// What a simulation server has of a world that it keeps ready.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct ReadyStatus {
    /// The world.
    pub world: ProjectUrl,
    /// How it is shown.
    #[serde(default)]
    pub mode: View,
    /// Number that is asked for now.
    #[serde(default)]
    pub wanted: u32,
    /// Number that a client can take at once.
    pub ready: u32,
    /// Number that is starting.
    #[serde(default)]
    pub starting: u32,
    /// Why the last start has failed, if it has.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}

/// Reads the list of a report. Entries that this version can't read are ignored.
///
/// # Errors
/// When it is no list.
pub fn lenient<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<ReadyStatus>, D::Error> {
    let entries = Vec::<Value>::deserialize(deserializer)?;
    Ok(entries
        .into_iter()
        .filter_map(|one| serde_json::from_value(one).ok())
        .collect())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const WORLD: &str = "https://github.com/lab/arm/blob/main/worlds/a.wbt";

    fn entry(more: &str) -> serde_json::Result<ReadyEntry> {
        serde_json::from_str(&format!(r#"{{"world": "{WORLD}", "count": 2{more}}}"#))
    }

    fn is_due(more: &str, at: &str) -> bool {
        entry(more).unwrap().is_due(at.parse().unwrap())
    }

    #[test]
    fn an_entry_is_due_at_its_times_in_its_time_zone() {
        let lesson = r#", "when": "Mon-Fri 07:50-12:00", "timeZone": "Europe/Zurich""#;
        for (more, at, expected, why) in [
            ("", "2026-11-24T03:00:00Z", true, "always"),
            (lesson, "2026-11-24T06:50:00Z", true, "Tuesday, winter: 07:50"),
            (lesson, "2026-11-24T06:49:59Z", false, "one second before"),
            (lesson, "2026-11-24T10:59:59Z", true, "one second before noon"),
            (lesson, "2026-11-24T11:00:00Z", false, "noon"),
            (lesson, "2026-07-21T05:50:00Z", true, "Tuesday, summer: 07:50"),
            (lesson, "2026-07-21T10:00:00Z", false, "summer: noon"),
            (lesson, "2026-11-28T08:00:00Z", false, "Saturday"),
            (
                r#", "when": ["Sat 00:00-24:00", "Sun 10:00-11:00"], "timeZone": "UTC""#,
                "2026-11-28T23:59:59Z",
                true,
                "Saturday",
            ),
            (
                r#", "when": ["Sat 00:00-24:00", "Sun 10:00-11:00"], "timeZone": "UTC""#,
                "2026-11-29T10:30:00Z",
                true,
                "Sunday",
            ),
            (
                r#", "until": "2026-12-24", "timeZone": "Europe/Zurich""#,
                "2026-12-24T22:59:59Z",
                true,
                "the last day",
            ),
            (
                r#", "until": "2026-12-24", "timeZone": "Europe/Zurich""#,
                "2026-12-24T23:00:00Z",
                false,
                "the day after",
            ),
            (
                r#", "from": "2026-12-24T08:00", "timeZone": "Europe/Zurich""#,
                "2026-12-24T06:59:59Z",
                false,
                "before",
            ),
            (
                r#", "from": "2026-12-24T08:00", "timeZone": "Europe/Zurich""#,
                "2026-12-24T07:00:00Z",
                true,
                "it begins",
            ),
            (
                r#", "until": "2026-12-24T09:30:00+01:00""#,
                "2026-12-24T08:30:00Z",
                false,
                "an exact time",
            ),
        ] {
            assert_eq!(is_due(more, at), expected, "{why}: {more} at {at}");
        }
    }

    #[test]
    fn what_is_wrong_is_told() {
        for (more, words) in [
            (
                r#", "when": "Mon-Fri""#,
                "\"Mon-Fri\" is no time of the week; allowed are",
            ),
            (r#", "when": "Fri-Mon 08:00-09:00""#, "no time of the week"),
            (r#", "when": "Mon 09:00-08:00""#, "no time of the week"),
            (r#", "when": "Mon 09:60-10:00""#, "no time of the week"),
            (r#", "when": "Mon 09:00-24:01""#, "no time of the week"),
            (r#", "timeZone": "Mars/Olympus""#, "\"Mars/Olympus\" is no time zone"),
            (r#", "until": "tomorrow""#, "\"tomorrow\" is no date"),
            (r#", "mode": "vr""#, "unknown variant `vr`"),
            (r#", "often": 1"#, "unknown field `often`"),
        ] {
            let error = entry(more).unwrap_err().to_string();
            assert!(error.contains(words), "{more}: {error}");
        }
        let error = serde_json::from_str::<ReadyEntry>(r#"{"world": "x", "count": 1}"#).unwrap_err();
        assert!(error.to_string().contains("Wrong Webots simulation URL"), "{error}");
    }

    #[test]
    fn an_entry_is_shown_as_it_was_written() {
        let more = r#", "when": ["Mon-Fri 07:50-12:00"], "timeZone": "Europe/Zurich", "from": null, "until": "2026-12-24", "mode": "mjpeg""#;
        let read = entry(more).unwrap();
        let text = serde_json::to_string(&read).unwrap();
        assert_eq!(serde_json::from_str::<ReadyEntry>(&text).unwrap(), read);
        assert!(
            text.contains("Mon-Fri 07:50-12:00") && text.contains("\"until\":\"2026-12-24\""),
            "{text}"
        );
    }

    proptest! {
        #[test]
        fn any_text_is_read(text: String) {
            let json = serde_json::to_string(&text).unwrap();
            for key in ["when", "timeZone", "from", "until"] {
                entry(&format!(r#", "{key}": {json}"#)).ok();
            }
        }
    }
}
