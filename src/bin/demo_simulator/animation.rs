//! A motion that Webots has recorded: the `animation.json` of an export. Each of its frames is sent as it stands in the
//! file, at its time. After the last one it begins again, with times that go on. Pure.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use serde_json::{Map, Number, Value};
use thiserror::Error;

/// Number of frames that are sent one by one. If more are due, in `fast` or after a pause of the thread, they are one
/// update: Webots too sends at most so many updates a second.
const MOST_FRAMES: usize = 3;

/// Why an animation cannot be shown.
#[derive(Debug, Error)]
pub(crate) enum AnimationError {
    #[error("{0}")]
    Syntax(#[from] serde_json::Error),
    #[error("it has no frames")]
    Empty,
    #[error("the frames are not in the order of their times")]
    Order,
}

/// A recorded motion.
#[derive(Debug)]
pub(crate) struct Animation {
    /// Length of a step, in milliseconds.
    pub(crate) step: f64,
    /// At least one, by time.
    frames: Vec<Frame>,
}

#[derive(Debug)]
struct Frame {
    /// As in the file.
    text: Box<RawValue>,
    content: Content,
}

#[derive(Debug, Deserialize)]
struct Content {
    /// In milliseconds.
    time: f64,
    #[serde(default)]
    updates: Vec<Change>,
    #[serde(default)]
    labels: Vec<Change>,
}

/// What changes at a node or a label.
#[derive(Debug, Deserialize, Serialize)]
struct Change {
    id: i64,
    #[serde(flatten)]
    fields: Map<String, Value>,
}

#[derive(Deserialize)]
struct File {
    #[serde(rename = "basicTimeStep")]
    basic_time_step: f64,
    frames: Vec<Box<RawValue>>,
}

#[derive(Serialize)]
struct Update {
    time: Number,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    updates: Vec<Change>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    labels: Vec<Change>,
}

impl Animation {
    /// Parses the content of an `animation.json`.
    pub(crate) fn parse(text: &str) -> Result<Self, AnimationError> {
        let file: File = serde_json::from_str(text)?;
        let frames = file
            .frames
            .into_iter()
            .map(|text| {
                let content = serde_json::from_str(text.get())?;
                Ok(Frame { text, content })
            })
            .collect::<Result<Vec<_>, serde_json::Error>>()?;
        if frames.is_empty() {
            return Err(AnimationError::Empty);
        }
        if !frames.is_sorted_by(|one, next| one.content.time <= next.content.time) {
            return Err(AnimationError::Order);
        }
        Ok(Self {
            step: file.basic_time_step.clamp(0.1, 10_000.0),
            frames,
        })
    }

    /// Frames per second.
    #[expect(clippy::cast_precision_loss, reason = "a file has fewer than 2^52 frames")]
    pub(crate) fn fps(&self) -> f64 {
        self.frames.len() as f64 * 1000.0 / self.length()
    }

    /// Returns, as JSON, the state of all nodes and labels at `time`, in milliseconds.
    pub(crate) fn state(&self, time: f64) -> String {
        merged(self.frames_until(self.place(time).1), time)
    }

    /// Returns, as JSON, what is to be sent of the time after `from` up to `to`, in milliseconds.
    pub(crate) fn updates(&self, from: f64, to: f64) -> Vec<String> {
        let (last_round, begin) = self.place(from);
        let (round, end) = self.place(to);
        let shown = self.frames_until(end);
        // The first frames have the poses of all nodes.
        let sent = if round > last_round {
            0
        } else {
            self.frames_until(begin).len()
        };
        let due = shown.get(sent..).unwrap_or_default();
        if due.len() > MOST_FRAMES {
            return vec![merged(due, to)];
        }
        due.iter()
            .map(|frame| {
                if round > 0.0 {
                    merged(std::slice::from_ref(frame), to - end + frame.content.time)
                } else {
                    frame.text.get().to_owned()
                }
            })
            .collect()
    }

    /// The round at `time`, counted from 0, and the time in this round.
    fn place(&self, time: f64) -> (f64, f64) {
        let round = (time / self.length()).floor();
        (round, time - round * self.length())
    }

    /// The length of a round, in milliseconds.
    fn length(&self) -> f64 {
        let last = self.frames.last().map_or(0.0, |frame| frame.content.time);
        last.max(0.0) + self.step
    }

    fn frames_until(&self, time: f64) -> &[Frame] {
        let count = self.frames.partition_point(|frame| frame.content.time <= time);
        self.frames.get(..count).unwrap_or_default()
    }
}

/// One update with the last values of all fields in these frames, as JSON.
fn merged(frames: &[Frame], time: f64) -> String {
    let update = Update {
        // via text, so that a whole number of milliseconds has no decimal point, as in Webots
        time: time.to_string().parse().unwrap_or_else(|_| 0.into()),
        updates: last_values(frames.iter().flat_map(|frame| &frame.content.updates)),
        labels: last_values(frames.iter().flat_map(|frame| &frame.content.labels)),
    };
    serde_json::to_string(&update).unwrap_or_default()
}

fn last_values<'a>(changes: impl Iterator<Item = &'a Change>) -> Vec<Change> {
    let mut all: BTreeMap<i64, Map<String, Value>> = BTreeMap::new();
    for change in changes {
        all.entry(change.id).or_default().extend(change.fields.clone());
    }
    all.into_iter().map(|(id, fields)| Change { id, fields }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAMES: [&str; 5] = [
        r#"{"time":0,"updates":[{"id":7,"translation":"0 0 0","rotation":"0 0 1 0"},{"id":8,"color":"1 0 0"}]}"#,
        r#"{"time":20,"updates":[{"id":7,"translation":"1 0 0"}]}"#,
        r#"{"time":40}"#,
        r#"{"time":60,"updates":[{"id":7,"rotation":"0 0 1 2"}],"labels":[{"id":0,"text":"hi"}]}"#,
        r#"{"time":80,"updates":[{"id":7,"translation":"2 0 0"}]}"#,
    ];

    fn animation() -> Animation {
        let text = format!(
            r#"{{ "basicTimeStep":20, "labelsIds":"", "frames":[{}] }}"#,
            FRAMES.join(",\n")
        );
        Animation::parse(&text).unwrap()
    }

    #[test]
    fn each_frame_is_sent_as_it_stands_in_the_file() {
        assert_eq!(animation().updates(0.0, 20.0), [FRAMES[1]]);
        assert_eq!(animation().updates(20.0, 20.0), [""; 0]);
        assert_eq!(animation().updates(20.0, 80.0), FRAMES[2..]);
    }

    #[test]
    fn more_frames_than_that_are_one_update() {
        let all = r#"{"time":80,"updates":[{"id":7,"rotation":"0 0 1 2","translation":"2 0 0"}],"labels":[{"id":0,"text":"hi"}]}"#;
        assert_eq!(animation().updates(0.0, 80.0), [all]);
    }

    #[test]
    fn the_state_has_the_last_values_of_all_fields() {
        let state =
            r#"{"time":50,"updates":[{"id":7,"rotation":"0 0 1 0","translation":"1 0 0"},{"id":8,"color":"1 0 0"}]}"#;
        assert_eq!(animation().state(50.0), state);
    }

    #[test]
    fn it_begins_again_after_the_last_frame_with_times_that_go_on() {
        let first =
            r#"{"time":100,"updates":[{"id":7,"rotation":"0 0 1 0","translation":"0 0 0"},{"id":8,"color":"1 0 0"}]}"#;
        assert_eq!(animation().updates(80.0, 100.0), [first]);
        let next = r#"{"time":120,"updates":[{"id":7,"translation":"1 0 0"}]}"#;
        assert_eq!(animation().updates(100.0, 120.0), [next]);
    }

    #[test]
    fn an_animation_that_cannot_be_shown_is_refused() {
        for (text, reason) in [
            (r#"{"basicTimeStep":20,"frames":[]}"#, "it has no frames"),
            (
                r#"{"basicTimeStep":20,"frames":[{"time":20},{"time":0}]}"#,
                "the frames are not in the order of their times",
            ),
            ("{", "EOF while parsing an object at line 1 column 1"),
        ] {
            assert_eq!(Animation::parse(text).unwrap_err().to_string(), reason);
        }
    }
}
