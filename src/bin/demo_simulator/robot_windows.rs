//! The windows of robots: pages of the project, which the world names.

use std::fs;
use std::path::Path;

use serde::Serialize;

/// The window of a robot, as a client is told of it.
#[derive(Debug, PartialEq, Serialize)]
pub(crate) struct RobotWindow {
    /// The robot's name.
    robot: String,
    /// The folder of the page in `plugins/robot_windows`.
    window: String,
    /// Whether it is the world's own window.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    main: bool,
}

/// The windows of the robots of a world; none if it can't be read. Blocks.
///
/// It finds robots at the top level of a world that Webots has saved: one field on a line, by two spaces farther in.
pub(crate) fn of_world(path: &Path) -> Vec<RobotWindow> {
    fs::read_to_string(path).map_or_else(|_| Vec::new(), |world| in_text(&world))
}

fn in_text(world: &str) -> Vec<RobotWindow> {
    let nodes: Vec<&str> = world.split("\n}").collect();
    let of_world = nodes.iter().find(|node| kind(node) == Some("WorldInfo"));
    let main = of_world.and_then(|node| field(node, "window"));
    let robots = nodes.into_iter().filter(|node| kind(node) != Some("WorldInfo"));
    robots
        .filter_map(|node| {
            let window = field(node, "window").filter(|window| *window != "<none>")?;
            let name = field(node, "name").or_else(|| kind(node))?;
            Some(RobotWindow {
                robot: name.to_owned(),
                window: window.to_owned(),
                main: main == Some(window),
            })
        })
        .collect()
}

/// The type of a node.
fn kind(node: &str) -> Option<&str> {
    let first = node.lines().find(|line| line.ends_with('{'))?;
    first.split_whitespace().rev().nth(1)
}

/// The text in a field of a node itself.
fn field<'a>(node: &'a str, name: &str) -> Option<&'a str> {
    let mut fields = node.lines().filter_map(|line| line.strip_prefix("  "));
    let value = fields.find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))?;
    value.strip_prefix('"')?.strip_suffix('"')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_windows_of_robots_are_found() {
        let world = "#VRML_SIM R2025a utf8\n\nWorldInfo {\n  window \"game\"\n}\nDEF A Thymio2 {\n  name \"one\"\n  window \"<none>\"\n}\n\
                     DEF B Robot {\n  children [\n    Robot {\n      window \"inner\"\n    }\n  ]\n  window \"game\"\n}\n\
                     E-puck {\n  name \"two\"\n  window \"radio\"\n}\n";
        let window = |robot: &str, window: &str, main| RobotWindow {
            robot: robot.to_owned(),
            window: window.to_owned(),
            main,
        };
        assert_eq!(
            in_text(world),
            [window("Robot", "game", true), window("two", "radio", false)]
        );
        assert_eq!(in_text("#VRML_SIM R2025a utf8\nRobot {\n}\n"), []);
    }
}
