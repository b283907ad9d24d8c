//! The nodes of a world file, as the parser makes them and the scene reads them.

use std::rc::Rc;

use crate::kinds::Kind;

/// A node of a known kind.
#[derive(Debug)]
pub(crate) struct Node {
    /// What it is.
    pub(crate) kind: &'static Kind,
    fields: Vec<(String, Value)>,
    height: usize,
}

/// The value of a field.
#[derive(Debug)]
pub(crate) enum Value {
    /// One or more numbers.
    Numbers(Vec<f64>),
    /// A string, or the first of a list.
    Text(String),
    /// `TRUE` or `FALSE`.
    Flag(bool),
    /// Nodes of known kinds; also `NULL`, the empty list, and what has been skipped.
    Nodes(Vec<Rc<Node>>),
}

impl Node {
    /// A node without any fields.
    pub(crate) fn new(kind: &'static Kind) -> Self {
        Self { kind, fields: Vec::new(), height: 1 }
    }

    /// How many nodes lie within each other here, itself included.
    pub(crate) fn height(&self) -> usize {
        self.height
    }

    /// Gives a field its value. The last one counts, so that a field repeated a million times takes no
    /// room.
    pub(crate) fn set(&mut self, field: &str, value: Value) {
        if let Value::Nodes(children) = &value {
            let tallest = children.iter().map(|child| child.height).max().unwrap_or(0);
            self.height = self.height.max(tallest + 1);
        }
        self.fields.retain(|(name, _)| name != field);
        self.fields.push((field.to_owned(), value));
    }

    /// The value of the field called `name`, if it is given.
    pub(crate) fn field(&self, name: &str) -> Option<&Value> {
        self.fields.iter().find(|(field, _)| field == name).map(|(_, value)| value)
    }

    /// The nodes in the field called `name`; none if it holds something else.
    pub(crate) fn nodes(&self, name: &str) -> &[Rc<Node>] {
        match self.field(name) {
            Some(Value::Nodes(nodes)) => nodes,
            _ => &[],
        }
    }

    /// The numbers in the field called `name`, if it holds exactly that many.
    pub(crate) fn numbers<const N: usize>(&self, name: &str) -> Option<[f64; N]> {
        match self.field(name) {
            Some(Value::Numbers(numbers)) => numbers.as_slice().try_into().ok(),
            _ => None,
        }
    }
}
