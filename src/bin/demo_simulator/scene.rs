//! What viewers see: the model as one XML document, made once for each world, and which of its nodes are
//! where at a given time. Pure.

use std::io;
use std::rc::Rc;

use quick_xml::events::{BytesDecl, BytesEnd, BytesStart, Event};
use quick_xml::writer::Writer;
use serde::Serialize;
use thiserror::Error;

use crate::kinds;
use crate::motion::{Path, Pose, PoseText};
use crate::node::{Node, Value};

/// Nodes of a model, counted after `USE` has been written out.
const MOST_NODES: u32 = 50_000;
/// Size of a model, in bytes.
const LARGEST_MODEL: usize = 32 * 1024 * 1024;

/// Why a world makes no scene.
#[derive(Debug, Error)]
pub(crate) enum SceneError {
    /// More nodes than are allowed.
    #[error("the model has more than {MOST_NODES} nodes")]
    TooManyNodes,
    /// A model that is larger than allowed.
    #[error("the model has more than {LARGEST_MODEL} bytes")]
    TooLarge,
    /// The XML could not be written.
    #[error("the model could not be written")]
    Write(#[from] io::Error),
}

/// A world as its viewers see it.
#[derive(Debug)]
pub(crate) struct Scene {
    /// The XML document.
    pub(crate) model: String,
    /// The numbers of the nodes that have a place.
    pub(crate) placed: Vec<u32>,
    movers: Vec<Mover>,
}

/// A node that moves.
#[derive(Debug)]
struct Mover {
    id: u32,
    path: Path,
    /// The pose that viewers were told last.
    shown: Pose,
}

/// An update of what viewers see.
#[derive(Serialize)]
struct Frame {
    time: serde_json::Number,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    updates: Vec<Update>,
}

#[derive(Serialize)]
struct Update {
    id: u32,
    #[serde(flatten)]
    pose: PoseText,
}

impl Scene {
    /// The scene made of the nodes at the top level of a world.
    pub(crate) fn new(nodes: &[Rc<Node>]) -> Result<Self, SceneError> {
        let mut author = Author { writer: Writer::new(Vec::new()), last_id: 0, placed: Vec::new(), movers: Vec::new() };
        author.document(nodes)?;
        let model = String::from_utf8(author.writer.into_inner()).map_err(io::Error::other)?;
        Ok(Self { model, placed: author.placed, movers: author.movers })
    }

    /// The update that names every node that moves, as JSON.
    pub(crate) fn everything(&mut self, time: f64) -> String {
        let updates = self.movers.iter_mut().map(|mover| {
            mover.shown = mover.path.pose_at(time);
            update(mover.id, mover.shown)
        });
        frame(time, updates.collect())
    }

    /// The update that names only what changed since the last of either, as JSON.
    pub(crate) fn changes(&mut self, time: f64) -> String {
        let mut updates = Vec::new();
        for mover in &mut self.movers {
            let pose = mover.path.pose_at(time);
            if pose.differs(&mover.shown) {
                mover.shown = pose;
                updates.push(update(mover.id, pose));
            }
        }
        frame(time, updates)
    }
}

fn update(id: u32, pose: Pose) -> Update {
    Update { id, pose: pose.to_text() }
}

fn frame(time: f64, updates: Vec<Update>) -> String {
    // by way of text, so that a whole number of milliseconds has no decimal point, as in Webots
    let time = time.to_string().parse().unwrap_or_else(|_| serde_json::Number::from(0));
    serde_json::to_string(&Frame { time, updates }).unwrap_or_default()
}

struct Author {
    writer: Writer<Vec<u8>>,
    last_id: u32,
    placed: Vec<u32>,
    movers: Vec<Mover>,
}

impl Author {
    fn document(&mut self, nodes: &[Rc<Node>]) -> Result<(), SceneError> {
        self.writer.write_event(Event::Decl(BytesDecl::new("1.0", Some("UTF-8"), None)))?;
        self.start(BytesStart::new("X3D"))?;
        self.start(BytesStart::new("head"))?;
        for (name, content) in [("generator", "Webots"), ("version", "R2025a"), ("simulator", "demo")] {
            let tag = BytesStart::new("meta").with_attributes([("name", name), ("content", content)]);
            self.writer.write_event(Event::Empty(tag))?;
        }
        self.end("head")?;
        self.start(BytesStart::new("Scene"))?;
        for node in nodes {
            self.node(node)?;
        }
        self.end("Scene")?;
        self.end("X3D")
    }

    /// Recursive; the parser has limited how deep nodes can lie within each other.
    fn node(&mut self, node: &Node) -> Result<(), SceneError> {
        self.last_id += 1;
        let id = self.last_id;
        if id > MOST_NODES {
            return Err(SceneError::TooManyNodes);
        }
        if self.writer.get_mut().len() > LARGEST_MODEL {
            return Err(SceneError::TooLarge);
        }
        if node.kind.placed {
            self.placed.push(id);
        }
        if node.kind.name == kinds::ROBOT {
            let start = start_pose(node);
            self.movers.push(Mover { id, path: Path::new(start, self.movers.len()), shown: start });
        }
        let tag = tag(node, id);
        let mut children = node.kind.children.iter().flat_map(|field| node.nodes(field)).peekable();
        if children.peek().is_none() {
            return Ok(self.writer.write_event(Event::Empty(tag))?);
        }
        self.start(tag)?;
        for child in children {
            self.node(child)?;
        }
        self.end(node.kind.name)
    }

    fn start(&mut self, tag: BytesStart<'_>) -> Result<(), SceneError> {
        Ok(self.writer.write_event(Event::Start(tag))?)
    }

    fn end(&mut self, name: &str) -> Result<(), SceneError> {
        Ok(self.writer.write_event(Event::End(BytesEnd::new(name)))?)
    }
}

fn tag(node: &Node, id: u32) -> BytesStart<'static> {
    let mut tag = BytesStart::new(node.kind.name);
    tag.push_attribute(("id", format!("n{id}").as_str()));
    for (field, attribute) in node.kind.attributes {
        if let Some(text) = node.field(field).and_then(attribute_text) {
            tag.push_attribute((*attribute, text.as_str()));
        }
    }
    tag
}

fn attribute_text(value: &Value) -> Option<String> {
    match value {
        Value::Numbers(numbers) => Some(numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")),
        Value::Text(text) => Some(text.chars().filter(|character| is_in_xml(*character)).collect()),
        Value::Flag(flag) => Some(flag.to_string()),
        Value::Nodes(_) => None,
    }
}

/// XML has no way to write the other characters.
fn is_in_xml(character: char) -> bool {
    !character.is_control() && !matches!(character, '\u{fffe}' | '\u{ffff}')
}

fn start_pose(node: &Node) -> Pose {
    let default = Pose::default();
    Pose {
        translation: node.numbers("translation").unwrap_or(default.translation),
        rotation: node.numbers("rotation").unwrap_or(default.rotation),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vrml::parse;

    fn scene(source: &str) -> Scene {
        Scene::new(&parse(source).unwrap()).unwrap()
    }

    #[test]
    fn only_robots_move_and_only_changes_are_named() {
        let mut scene = scene("Solid { } Robot { translation 1 2 3 } Pose { children Robot { } }");
        assert_eq!(scene.placed, [1, 2, 3, 4]);
        assert_eq!(
            scene.everything(0.0),
            r#"{"time":0,"updates":[{"id":2,"translation":"1 2 3","rotation":"0 0 1 0"},{"id":4,"translation":"0 0 0","rotation":"0 0 1 0"}]}"#
        );
        assert_eq!(scene.changes(0.0), r#"{"time":0}"#, "nothing changed yet");
        let update = scene.changes(32.0);
        assert!(update.starts_with(r#"{"time":32,"updates":[{"id":2,"#), "{update}");
        assert_eq!(scene.changes(32.0), r#"{"time":32}"#);
        assert_eq!(scene.everything(32.0), update, "the same time gives the same poses");
    }

    #[test]
    fn a_world_that_multiplies_by_use_is_refused() {
        let doubling: Vec<String> =
            (1..60).map(|i| format!("DEF N{i} Group{{children[USE N{0} USE N{0}]}}\n", i - 1)).collect();
        let doubling = doubling.concat();
        let nodes = parse(&format!("DEF N0 Box{{}}\n{doubling}")).unwrap();
        assert!(matches!(Scene::new(&nodes), Err(SceneError::TooManyNodes)));
    }
}
