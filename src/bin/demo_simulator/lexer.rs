//! Cuts a world file into tokens. Pure; the parser drives it.

/// The smallest parts of a world file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Token<'a> {
    /// A name or a number.
    Word(&'a str),
    /// A string as written between its quotes, escapes included.
    Text(&'a str),
    /// `{`
    OpenBrace,
    /// `}`
    CloseBrace,
    /// `[`
    OpenBracket,
    /// `]`
    CloseBracket,
    /// A string whose end is missing.
    Unterminated,
}

/// The tokens of a text, in order. A clone looks ahead.
#[derive(Clone, Debug)]
pub(crate) struct Lexer<'a> {
    source: &'a str,
    rest: &'a str,
}

impl<'a> Lexer<'a> {
    /// Starts at the beginning of `source`.
    pub(crate) fn new(source: &'a str) -> Self {
        Self { source, rest: source }
    }

    /// The number of the line that has been reached, from 1.
    pub(crate) fn line(&self) -> usize {
        let (read, _) = self.source.split_at(self.source.len() - self.rest.len());
        read.matches('\n').count() + 1
    }

    /// The next token, which stays to be read.
    pub(crate) fn peek(&self) -> Option<Token<'a>> {
        self.clone().next()
    }

    fn skip_blanks_and_comments(&mut self) {
        loop {
            self.rest = self.rest.trim_start_matches(is_blank);
            if !self.rest.starts_with('#') {
                return;
            }
            self.rest = self.rest.split_once('\n').map_or("", |(_, after)| after);
        }
    }

    fn text(&mut self, body: &'a str) -> Token<'a> {
        let mut escaped = false;
        for (end, character) in body.char_indices() {
            match character {
                _ if escaped => escaped = false,
                '\\' => escaped = true,
                '"' => {
                    let (text, after) = body.split_at(end);
                    self.rest = after.strip_prefix('"').unwrap_or(after);
                    return Token::Text(text);
                }
                _ => (),
            }
        }
        self.rest = "";
        Token::Unterminated
    }
}

impl<'a> Iterator for Lexer<'a> {
    type Item = Token<'a>;

    fn next(&mut self) -> Option<Token<'a>> {
        self.skip_blanks_and_comments();
        let mut characters = self.rest.chars();
        let token = match characters.next()? {
            '{' => Token::OpenBrace,
            '}' => Token::CloseBrace,
            '[' => Token::OpenBracket,
            ']' => Token::CloseBracket,
            '"' => return Some(self.text(characters.as_str())),
            _ => {
                let end = self.rest.find(ends_word).unwrap_or(self.rest.len());
                let (word, after) = self.rest.split_at(end);
                self.rest = after;
                return Some(Token::Word(word));
            }
        };
        self.rest = characters.as_str();
        Some(token)
    }
}

fn is_blank(character: char) -> bool {
    character.is_whitespace() || character == ','
}

fn ends_word(character: char) -> bool {
    is_blank(character) || matches!(character, '{' | '}' | '[' | ']' | '"' | '#')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_told_apart_without_needing_blanks() {
        use Token::{CloseBrace, CloseBracket, OpenBrace, OpenBracket, Text, Word};
        for (source, expected) in [
            ("", vec![]),
            (" ,\n\t", vec![]),
            ("# only a comment", vec![]),
            (
                "Box{size 1 2,3}",
                vec![Word("Box"), OpenBrace, Word("size"), Word("1"), Word("2"), Word("3"), CloseBrace],
            ),
            ("[a]#x {\nb", vec![OpenBracket, Word("a"), CloseBracket, Word("b")]),
            (r#"name"a } # \" b""#, vec![Word("name"), Text(r#"a } # \" b"#)]),
            (r#""\\"x"#, vec![Text(r"\\"), Word("x")]),
            ("\"never", vec![Token::Unterminated]),
            ("\"never\\", vec![Token::Unterminated]),
            ("é{\"ü\"", vec![Word("é"), OpenBrace, Text("ü")]),
        ] {
            assert_eq!(Lexer::new(source).collect::<Vec<_>>(), expected, "{source:?}");
        }
    }

    #[test]
    fn lines_count_from_one_and_strings_and_comments_count_too() {
        let mut lexer = Lexer::new("a\n# b\n\"c\nd\" e");
        assert_eq!(lexer.line(), 1);
        lexer.by_ref().take(2).for_each(drop);
        assert_eq!(lexer.line(), 4);
    }

    #[test]
    fn peeking_reads_nothing() {
        let mut lexer = Lexer::new("a b");
        assert_eq!(lexer.peek(), Some(Token::Word("a")));
        assert_eq!(lexer.next(), Some(Token::Word("a")));
    }
}
