//! Parses the body of a world file into nodes. Pure. Whatever the file holds, the work and the memory stay
//! bounded and the stack shallow: nodes of unknown kinds are skipped by counting braces, and the depth
//! and the number of the known ones are limited.

use std::collections::HashMap;
use std::rc::Rc;

use thiserror::Error;

use crate::kinds;
use crate::lexer::{Lexer, Token};
use crate::node::{Node, Value};

/// Nodes in nodes, counted through `USE`.
const DEEPEST: usize = 64;
/// Nodes in a file.
const MOST_NODES: usize = 100_000;
/// Numbers kept of one field: no field that is passed on has more.
const MOST_NUMBERS: usize = 16;

/// Why a world file cannot be parsed.
#[derive(Debug, Error, PartialEq)]
pub(crate) enum SyntaxError {
    /// Something that cannot stand where it is.
    #[error("line {line}: expected {expected}, found {found}")]
    Unexpected {
        /// The line, from 1.
        line: usize,
        /// What could stand there.
        expected: &'static str,
        /// What does.
        found: String,
    },
    /// More nodes within each other than are allowed.
    #[error("line {line}: more than {DEEPEST} nodes within each other")]
    TooDeep {
        /// The line, from 1.
        line: usize,
    },
    /// More nodes than are allowed.
    #[error("line {line}: more than {MOST_NODES} nodes")]
    TooMany {
        /// The line, from 1.
        line: usize,
    },
}

/// Parses the nodes at the top level of a world file, whose header has been read before.
pub(crate) fn parse(source: &str) -> Result<Vec<Rc<Node>>, SyntaxError> {
    let mut parser = Parser { lexer: Lexer::new(source), named: HashMap::new(), nodes: 0 };
    let mut top = Vec::new();
    while let Some(token) = parser.lexer.next() {
        match token {
            Token::Word("IMPORTABLE") => (),
            Token::Word("EXTERNPROTO") => parser.skip_text()?,
            Token::Word(word) => top.extend(parser.node(word, DEEPEST)?),
            _ => return Err(parser.unexpected("a node", Some(token))),
        }
    }
    Ok(top)
}

struct Parser<'a> {
    lexer: Lexer<'a>,
    /// What `DEF` has named so far.
    named: HashMap<&'a str, Rc<Node>>,
    nodes: usize,
}

impl<'a> Parser<'a> {
    /// A node whose first word has been read; nothing if it is not of a known kind. `room` is how many
    /// nodes may still lie within each other, this one included.
    fn node(&mut self, first: &'a str, room: usize) -> Result<Option<Rc<Node>>, SyntaxError> {
        match first {
            "USE" => {
                let name = self.word("a name after USE")?;
                let node = self.named.get(name).cloned();
                match node {
                    Some(node) if node.height() > room => Err(SyntaxError::TooDeep { line: self.lexer.line() }),
                    node => Ok(node),
                }
            }
            "DEF" => {
                let name = self.word("a name after DEF")?;
                let kind = self.word("a node after DEF")?;
                let node = self.body(kind, room)?;
                if let Some(node) = &node {
                    self.named.insert(name, Rc::clone(node));
                }
                Ok(node)
            }
            kind => self.body(kind, room),
        }
    }

    fn body(&mut self, kind: &str, room: usize) -> Result<Option<Rc<Node>>, SyntaxError> {
        self.expect(Token::OpenBrace, "{")?;
        let Some(kind) = kinds::find(kind) else {
            self.skip_to_close(1)?;
            return Ok(None);
        };
        self.nodes += 1;
        if self.nodes > MOST_NODES {
            return Err(SyntaxError::TooMany { line: self.lexer.line() });
        }
        let Some(room) = room.checked_sub(1) else {
            return Err(SyntaxError::TooDeep { line: self.lexer.line() });
        };
        let mut node = Node::new(kind);
        loop {
            match self.lexer.next() {
                Some(Token::CloseBrace) => return Ok(Some(Rc::new(node))),
                Some(Token::Word("hidden")) => (),
                Some(Token::Word(field)) => self.field(&mut node, field, room)?,
                other => return Err(self.unexpected("a field or }", other)),
            }
        }
    }

    /// Reads the value of a field, and keeps it if it will be passed on.
    fn field(&mut self, node: &mut Node, field: &str, room: usize) -> Result<(), SyntaxError> {
        let kind = node.kind;
        let is_child = kind.children.contains(&field);
        let is_kept = is_child || kind.attributes.iter().any(|(name, _)| *name == field);
        if !is_kept {
            return self.skip_value();
        }
        let value = self.value(room)?;
        node.set(field, value);
        Ok(())
    }

    fn value(&mut self, room: usize) -> Result<Value, SyntaxError> {
        match self.lexer.next() {
            Some(Token::Text(text)) => Ok(Value::Text(unescape(text))),
            Some(Token::Word("TRUE")) => Ok(Value::Flag(true)),
            Some(Token::Word("FALSE")) => Ok(Value::Flag(false)),
            Some(Token::Word("NULL")) => Ok(Value::Nodes(Vec::new())),
            Some(Token::Word(word)) => match number(word) {
                Some(first) => Ok(Value::Numbers(self.numbers(first))),
                None => Ok(Value::Nodes(self.node(word, room)?.into_iter().collect())),
            },
            Some(Token::OpenBracket) => self.list(room),
            other => Err(self.unexpected("a value", other)),
        }
    }

    fn numbers(&mut self, first: f64) -> Vec<f64> {
        let mut numbers = vec![first];
        while let Some(Token::Word(word)) = self.lexer.peek() {
            let Some(number) = number(word) else { break };
            self.lexer.next();
            if numbers.len() < MOST_NUMBERS {
                numbers.push(number);
            }
        }
        numbers
    }

    fn list(&mut self, room: usize) -> Result<Value, SyntaxError> {
        let mut nodes = Vec::new();
        let mut simple = None;
        loop {
            match self.lexer.next() {
                Some(Token::CloseBracket) => return Ok(simple.unwrap_or(Value::Nodes(nodes))),
                Some(Token::Text(text)) => {
                    simple.get_or_insert_with(|| Value::Text(unescape(text)));
                }
                Some(Token::Word("TRUE" | "FALSE" | "NULL")) => (),
                Some(Token::Word(word)) => match number(word) {
                    Some(first) => simple = Some(Value::Numbers(self.numbers(first))),
                    None => nodes.extend(self.node(word, room)?),
                },
                other => return Err(self.unexpected("an item or ]", other)),
            }
        }
    }

    /// Skips the value of a field that is not passed on.
    fn skip_value(&mut self) -> Result<(), SyntaxError> {
        match self.lexer.next() {
            Some(Token::Text(_) | Token::Word("TRUE" | "FALSE" | "NULL")) => Ok(()),
            Some(Token::OpenBracket) => self.skip_to_close(1),
            Some(Token::Word("USE")) => self.word("a name after USE").map(drop),
            Some(Token::Word("DEF")) => {
                self.word("a name after DEF")?;
                self.word("a node after DEF")?;
                self.expect(Token::OpenBrace, "{")?;
                self.skip_to_close(1)
            }
            Some(Token::Word(word)) => {
                if let Some(first) = number(word) {
                    self.numbers(first);
                    return Ok(());
                }
                self.expect(Token::OpenBrace, "{")?;
                self.skip_to_close(1)
            }
            other => Err(self.unexpected("a value", other)),
        }
    }

    /// Skips until `depth` braces and brackets are closed again.
    fn skip_to_close(&mut self, mut depth: usize) -> Result<(), SyntaxError> {
        while depth > 0 {
            match self.lexer.next() {
                Some(Token::OpenBrace | Token::OpenBracket) => depth += 1,
                Some(Token::CloseBrace | Token::CloseBracket) => depth -= 1,
                Some(Token::Word(_) | Token::Text(_)) => (),
                other => return Err(self.unexpected("} or ]", other)),
            }
        }
        Ok(())
    }

    fn skip_text(&mut self) -> Result<(), SyntaxError> {
        match self.lexer.next() {
            Some(Token::Text(_)) => Ok(()),
            other => Err(self.unexpected("a string", other)),
        }
    }

    fn word(&mut self, expected: &'static str) -> Result<&'a str, SyntaxError> {
        match self.lexer.next() {
            Some(Token::Word(word)) => Ok(word),
            other => Err(self.unexpected(expected, other)),
        }
    }

    fn expect(&mut self, token: Token<'_>, expected: &'static str) -> Result<(), SyntaxError> {
        match self.lexer.next() {
            Some(found) if found == token => Ok(()),
            other => Err(self.unexpected(expected, other)),
        }
    }

    fn unexpected(&self, expected: &'static str, found: Option<Token<'_>>) -> SyntaxError {
        let found = match found {
            Some(Token::Word(word)) => format!("{:?}", word.chars().take(40).collect::<String>()),
            Some(Token::Text(_)) => "a string".to_owned(),
            Some(Token::OpenBrace) => "{".to_owned(),
            Some(Token::CloseBrace) => "}".to_owned(),
            Some(Token::OpenBracket) => "[".to_owned(),
            Some(Token::CloseBracket) => "]".to_owned(),
            Some(Token::Unterminated) => "a string without an end".to_owned(),
            None => "the end of the file".to_owned(),
        };
        SyntaxError::Unexpected { line: self.lexer.line(), expected, found }
    }
}

fn number(word: &str) -> Option<f64> {
    // Rust would also read `inf` and `NaN`, which are names here
    let is_number = word.starts_with(|first: char| first.is_ascii_digit() || matches!(first, '-' | '+' | '.'));
    word.parse().ok().filter(|number: &f64| is_number && number.is_finite())
}

fn unescape(text: &str) -> String {
    let mut result = String::with_capacity(text.len());
    let mut characters = text.chars();
    while let Some(character) = characters.next() {
        match character {
            '\\' => result.extend(characters.next()),
            character => result.push(character),
        }
    }
    result
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn outline(nodes: &[Rc<Node>]) -> String {
        let one = |node: &Rc<Node>| {
            let inner: String = node.kind.children.iter().map(|field| outline(node.nodes(field))).collect();
            format!("{}({inner})", node.kind.name)
        };
        nodes.iter().map(one).collect()
    }

    #[test]
    fn known_nodes_are_kept_and_unknown_ones_skipped_whole() {
        for (source, expected) in [
            ("", ""),
            ("WorldInfo { } Viewpoint {}", "WorldInfo()Viewpoint()"),
            ("EXTERNPROTO \"a.proto\" IMPORTABLE EXTERNPROTO \"b.proto\" Group {}", "Group()"),
            ("Floor { size 1 2 appearance Parquetry { type \"}\" # }\n } } Group {}", "Group()"),
            (
                "Solid { children [ Shape { geometry Box { size 1 2 3 } } Odd { a [ { ] } } Pose {} ] }",
                "Solid(Shape(Box())Pose())",
            ),
            ("Solid { boundingObject Box { } physics DEF P Physics { } children Pose { } }", "Solid(Pose())"),
            ("DEF A Group { children DEF B Pose { } } USE B USE A", "Group(Pose())Pose()Group(Pose())"),
            ("USE NOBODY Group { children USE NOBODY }", "Group()"),
            ("Robot { hidden position_0_0 1.5 children [] name \"a\" supervisor TRUE window NULL }", "Robot()"),
            (
                "Shape { appearance Appearance { material Material { diffuseColor 1 0 0 } } }",
                "Shape(Appearance(Material()))",
            ),
        ] {
            assert_eq!(outline(&parse(source).expect(source)), expected, "{source}");
        }
    }

    #[test]
    fn fields_keep_their_values() {
        let nodes =
            parse(r#"Robot { name "a \"b\" \\" translation 1 -2.5 +3e-1 rotation [0, 0 1 .5] } WorldInfo { FPS 30 }"#);
        let nodes = nodes.unwrap();
        assert!(matches!(nodes[0].field("name"), Some(Value::Text(name)) if name == r#"a "b" \"#));
        assert_eq!(nodes[0].numbers("translation"), Some([1.0, -2.5, 0.3]));
        assert_eq!(nodes[0].numbers("rotation"), Some([0.0, 0.0, 1.0, 0.5]));
        assert_eq!(nodes[0].numbers::<2>("translation"), None);
        assert_eq!(nodes[1].numbers("FPS"), Some([30.0]));
    }

    #[test]
    fn broken_worlds_are_refused_with_the_line() {
        for (source, message) in [
            ("}", "line 1: expected a node, found }"),
            ("Solid {\n\n", "line 3: expected a field or }, found the end of the file"),
            ("Solid {\nname }", "line 2: expected a value, found }"),
            ("Solid {\nname \"x }", "line 2: expected a value, found a string without an end"),
            ("Solid\nSolid", "line 2: expected {, found \"Solid\""),
            ("Odd { { }", "line 1: expected } or ], found the end of the file"),
            ("Solid { children [ [ ] ] }", "line 1: expected an item or ], found ["),
            ("Box { size inf 0 0 }", "line 1: expected {, found \"0\""),
            ("Box { size 1e999 0 0 }", "line 1: expected {, found \"0\""),
            ("DEF", "line 1: expected a name after DEF, found the end of the file"),
            ("EXTERNPROTO x", "line 1: expected a string, found \"x\""),
        ] {
            assert_eq!(parse(source).unwrap_err().to_string(), message, "{source}");
        }
    }

    #[test]
    fn nesting_is_limited_by_braces_and_by_use() {
        let nested = |depth| format!("{}{}", "Group{children ".repeat(depth) + "Box{}", "}".repeat(depth));
        assert!(parse(&nested(DEEPEST - 1)).is_ok());
        assert_eq!(parse(&nested(DEEPEST)).unwrap_err(), SyntaxError::TooDeep { line: 1 });
        assert_eq!(parse(&nested(1_000_000)).unwrap_err(), SyntaxError::TooDeep { line: 1 });

        let chain: Vec<String> =
            (1..DEEPEST + 9).map(|i| format!("DEF N{i} Group{{children USE N{}}}\n", i - 1)).collect();
        let chain = chain.concat();
        assert_eq!(parse(&format!("DEF N0 Box{{}}\n{chain}")).unwrap_err(), SyntaxError::TooDeep { line: DEEPEST + 1 });
    }

    #[test]
    fn unknown_nodes_may_nest_deeply_as_they_are_only_counted() {
        let depth = 1_000_000;
        assert!(parse(&format!("{}{}", "Odd{a ".repeat(depth), "}".repeat(depth))).is_ok());
    }

    #[test]
    fn the_number_of_nodes_is_limited() {
        assert_eq!(parse(&"Box{}".repeat(MOST_NODES + 1)).unwrap_err(), SyntaxError::TooMany { line: 1 });
    }

    proptest! {
        #[test]
        fn no_text_makes_the_parser_panic(source in any::<String>()) {
            drop(parse(&source));
        }

        #[test]
        fn no_mix_of_real_words_makes_the_parser_panic(
            words in prop::collection::vec(
                prop::sample::select(vec![
                    "Solid", "Robot", "Shape", "Box", "Odd", "DEF", "USE", "A", "B", "{", "}", "[", "]", "children",
                    "geometry", "size", "name", "\"x\"", "\"", "\\", "#", "\n", "1", "-2.5", "NULL", "TRUE", "hidden",
                    "EXTERNPROTO",
                ]),
                0..60,
            )
        ) {
            drop(parse(&words.join(" ")));
        }
    }
}
