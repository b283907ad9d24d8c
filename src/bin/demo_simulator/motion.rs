//! The motion of robots: each drives in a circle. A pose depends on simulation time alone, so that it is the same again
//! after a reset. Pure.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

/// A robot that drives in a circle through its start, as a `.motion.json` file describes it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Robot {
    /// The number of its node in the model: 20 for `id="n20"`.
    id: u32,
    /// x, y, z at time 0, in metres.
    start: [f64; 3],
    /// Direction at time 0, in radians from the x axis about the vertical axis.
    heading: f64,
    /// Radius of the circle, in metres; negative for a right turn.
    radius: f64,
    /// Speed, in metres per second.
    speed: f64,
}

/// The pose of a robot, as it is sent to clients.
#[derive(Debug, PartialEq, Serialize)]
pub(crate) struct Pose {
    id: u32,
    translation: String,
    rotation: String,
}

impl Robot {
    /// Returns the pose at `time`, in milliseconds.
    pub(crate) fn pose(&self, time: f64) -> Pose {
        let turned = self.speed / self.radius * time / 1000.0;
        let angle = self.heading + if turned.is_finite() { turned } else { 0.0 };
        let [x, y, z] = self.start;
        let translation = [
            x + self.radius * (angle.sin() - self.heading.sin()),
            y - self.radius * (angle.cos() - self.heading.cos()),
            z,
        ];
        Pose {
            id: self.id,
            translation: text(&translation),
            rotation: text(&[0.0, 0.0, 1.0, angle % TAU]),
        }
    }
}

/// The numbers, rounded to 0.0001.
fn text(numbers: &[f64]) -> String {
    // adding zero makes 0 of -0
    let texts: Vec<String> = numbers
        .iter()
        .map(|number| ((number * 1e4).round() / 1e4 + 0.0).to_string())
        .collect();
    texts.join(" ")
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn pose(heading: f64, radius: f64, seconds: f64) -> (String, String) {
        let robot = Robot {
            id: 1,
            start: [1.0, 2.0, 0.5],
            heading,
            radius,
            speed: 0.25,
        };
        let pose = robot.pose(seconds * 1000.0);
        (pose.translation, pose.rotation)
    }

    #[test]
    fn a_robot_drives_in_a_circle_through_its_start() {
        for (heading, radius, rounds, translation, rotation) in [
            (0.0, 0.5, 0.0, "1 2 0.5", "0 0 1 0"),
            (0.0, 0.5, 0.25, "1.5 2.5 0.5", "0 0 1 1.5708"),
            (0.0, 0.5, 0.5, "1 3 0.5", "0 0 1 3.1416"),
            (0.0, 0.5, 1.0, "1 2 0.5", "0 0 1 0"),
            (0.0, -0.5, 0.25, "1.5 1.5 0.5", "0 0 1 -1.5708"),
            (PI, 0.5, 0.25, "0.5 1.5 0.5", "0 0 1 4.7124"),
            (1.2, 0.0, 1.0, "1 2 0.5", "0 0 1 1.2"),
        ] {
            let seconds = rounds * TAU * f64::abs(radius) / 0.25;
            assert_eq!(
                pose(heading, radius, seconds),
                (translation.to_owned(), rotation.to_owned()),
                "{radius} {rounds}"
            );
        }
    }
}
