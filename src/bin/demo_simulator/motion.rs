//! Where things are and how robots move: each drives its own circle through the place it starts from. A
//! pose depends on simulation time alone, so a reset or a step can be checked. Pure.

use serde::Serialize;

/// How fast robots drive, in metres per second.
const SPEED: f64 = 0.25;
/// The circles' radii in metres, dealt out in turn. A negative one turns right.
const RADII: [f64; 4] = [0.4, -0.6, 0.8, -0.3];

/// A place in the parent's coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose {
    /// x, y, z in metres.
    pub(crate) translation: [f64; 3],
    /// An axis and an angle in radians.
    pub(crate) rotation: [f64; 4],
}

/// A pose as an update of a viewer names it.
#[derive(Debug, PartialEq, Serialize)]
pub(crate) struct PoseText {
    translation: String,
    rotation: String,
}

impl Default for Pose {
    fn default() -> Self {
        Self { translation: [0.0; 3], rotation: [0.0, 0.0, 1.0, 0.0] }
    }
}

impl Pose {
    /// Whether a viewer could tell the two apart.
    pub(crate) fn differs(&self, other: &Self) -> bool {
        let numbers = self.translation.iter().chain(&self.rotation);
        let others = other.translation.iter().chain(&other.rotation);
        numbers.zip(others).any(|(a, b)| (a - b).abs() >= 1e-3)
    }

    /// The numbers as text, rounded to 0.0001.
    pub(crate) fn to_text(self) -> PoseText {
        PoseText { translation: join_rounded(&self.translation), rotation: join_rounded(&self.rotation) }
    }
}

/// The path of one robot.
#[derive(Debug)]
pub(crate) struct Path {
    start: Pose,
    radius: f64,
}

impl Path {
    /// The path of the `index`th robot, which stands at `start` at time 0.
    pub(crate) fn new(start: Pose, index: usize) -> Self {
        let radius = RADII.get(index % RADII.len()).copied().unwrap_or(1.0);
        Self { start, radius }
    }

    /// Where the robot is at `time` milliseconds.
    pub(crate) fn pose_at(&self, time: f64) -> Pose {
        let turned = SPEED / self.radius * time / 1000.0;
        if turned == 0.0 {
            return self.start;
        }
        let [w, x, y, z] = quaternion(self.start.rotation);
        let heading = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
        let [start_x, start_y, start_z] = self.start.translation;
        let ahead = heading + turned;
        Pose {
            translation: [
                start_x + self.radius * (ahead.sin() - heading.sin()),
                start_y - self.radius * (ahead.cos() - heading.cos()),
                start_z,
            ],
            rotation: turn_about_z([w, x, y, z], turned),
        }
    }
}

fn quaternion([x, y, z, angle]: [f64; 4]) -> [f64; 4] {
    let length = (x * x + y * y + z * z).sqrt();
    if length == 0.0 {
        return [1.0, 0.0, 0.0, 0.0];
    }
    let (sin, cos) = (angle / 2.0).sin_cos();
    [cos, x / length * sin, y / length * sin, z / length * sin]
}

/// The rotation that first does `quaternion`, then turns by `angle` about the vertical axis.
fn turn_about_z([w, x, y, z]: [f64; 4], angle: f64) -> [f64; 4] {
    let (sin, cos) = (angle / 2.0).sin_cos();
    let turned = [cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w];
    // of the two ways to write a rotation, the one with the smaller angle
    let side = if turned[0] < 0.0 { -1.0 } else { 1.0 };
    let [w, x, y, z] = turned.map(|part| part * side);
    let length = (x * x + y * y + z * z).sqrt();
    if length < 1e-9 {
        return [0.0, 0.0, 1.0, 0.0];
    }
    [x / length, y / length, z / length, 2.0 * length.atan2(w)]
}

fn join_rounded(numbers: &[f64]) -> String {
    // the zero added turns -0 into 0
    let texts: Vec<String> = numbers.iter().map(|number| ((number * 1e4).round() / 1e4 + 0.0).to_string()).collect();
    texts.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: &[f64], b: &[f64]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9)
    }

    #[test]
    fn a_robot_starts_exactly_where_the_world_puts_it() {
        let start = Pose { translation: [1.0, 2.0, 3.0], rotation: [0.2, 0.9, 0.1, 2.0] };
        assert_eq!(Path::new(start, 0).pose_at(0.0), start);
    }

    #[test]
    fn a_robot_sets_off_in_the_direction_it_faces() {
        for (rotation, direction) in [
            ([0.0, 0.0, 1.0, 0.0], [1.0, 0.0]),
            ([0.0, 0.0, 1.0, 1.0], [1_f64.cos(), 1_f64.sin()]),
            ([0.0, 0.0, -1.0, 1.0], [1_f64.cos(), -1_f64.sin()]),
            ([0.0, 0.0, 0.0, 1.0], [1.0, 0.0]),
        ] {
            let path = Path::new(Pose { rotation, ..Pose::default() }, 0);
            let [x, y, z] = path.pose_at(1.0).translation;
            let moved = SPEED / 1000.0;
            assert!(
                (x / moved - direction[0]).abs() < 1e-3 && (y / moved - direction[1]).abs() < 1e-3,
                "{rotation:?}: {x} {y}"
            );
            assert!(z.abs() < 1e-12);
        }
    }

    #[test]
    fn after_a_round_a_robot_is_back() {
        for (index, radius) in RADII.into_iter().enumerate() {
            let path = Path::new(Pose { translation: [0.5, -1.0, 0.1], rotation: [0.0, 0.0, 1.0, 0.7] }, index);
            let round = std::f64::consts::TAU * radius.abs() / SPEED * 1000.0;
            let pose = path.pose_at(round);
            assert!(!pose.differs(&path.pose_at(0.0)), "{pose:?}");
            assert!(pose.differs(&path.pose_at(round / 2.0)));
        }
    }

    #[test]
    fn turning_keeps_a_tilt() {
        let [x, y, z, angle] = turn_about_z(quaternion([1.0, 0.0, 0.0, 0.5]), 0.0);
        assert!(close(&[x, y, z, angle], &[1.0, 0.0, 0.0, 0.5]));
        let turned = turn_about_z(quaternion([0.0, 0.0, 1.0, 0.5]), 0.25);
        assert!(close(&turned, &[0.0, 0.0, 1.0, 0.75]));
    }

    #[test]
    fn numbers_are_rounded_and_zero_has_no_sign() {
        let pose = Pose { translation: [1.0, -0.000_01, 0.123_456], rotation: [0.0, 0.0, 1.0, 3.0] };
        let text = pose.to_text();
        assert_eq!((text.translation.as_str(), text.rotation.as_str()), ("1 0 0.1235", "0 0 1 3"));
    }

    #[test]
    fn poses_differ_from_a_thousandth_on() {
        let pose = Pose::default();
        assert!(!pose.differs(&Pose { translation: [0.0009, 0.0, 0.0], ..pose }));
        assert!(pose.differs(&Pose { rotation: [0.0, 0.0, 1.0, -0.0011], ..pose }));
    }
}
