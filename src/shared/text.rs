//! Texts from outside. Pure.

use icu_properties::props::{BinaryProperty, DefaultIgnorableCodePoint};

/// Returns a text in which nothing begins a new line, steers a terminal, changes the direction of writing, or is invisible.
///
/// Control characters become spaces; invisible characters, which those for the direction are among, become U+FFFD.
pub fn one_line(text: &str) -> String {
    let visible = |letter: char| match letter {
        // Most are of this kind, and need no look into Unicode's tables.
        ' '..='~' => letter,
        '\u{2028}' | '\u{2029}' => ' ',
        letter if letter.is_control() => ' ',
        letter if DefaultIgnorableCodePoint::for_char(letter) => char::REPLACEMENT_CHARACTER,
        letter => letter,
    };
    text.chars().map(visible).collect()
}

/// Returns a text as one line of at most so many letters, with `...` where it was cut.
pub fn excerpt(text: &str, most: usize) -> String {
    let mut excerpt: String = one_line(text).chars().take(most).collect();
    if text.chars().nth(most).is_some() {
        excerpt.push_str("...");
    }
    excerpt
}

/// Returns a text for a web client in one line, in which nothing begins a tag or a character reference of HTML.
///
/// Webots' page puts such texts into `innerHTML`. Other clients show them as they are, so that the characters are replaced
/// by similar ones instead of being escaped.
pub fn client_text(text: &str) -> String {
    let harmless = |letter: char| match letter {
        '<' => '\u{2039}',
        '>' => '\u{203a}',
        '&' => '\u{ff06}',
        letter => letter,
    };
    one_line(text).chars().map(harmless).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_for_a_client_is_no_html() {
        let text = "<img src=x onerror='alert(1)'>\n&lt;b&gt;";
        let shown = "\u{2039}img src=x onerror='alert(1)'\u{203a} \u{ff06}lt;b\u{ff06}gt;";
        assert_eq!(client_text(text), shown);
    }

    #[test]
    fn an_excerpt_is_one_short_line() {
        assert_eq!(excerpt("a\r\nBcc: x\u{7}\u{85}y", 500), "a  Bcc: x  y");
        let long = excerpt(&"\u{e9}".repeat(600), 500);
        assert_eq!((long.chars().count(), long.ends_with("\u{e9}...")), (503, true));
    }

    #[test]
    fn nothing_hides_in_a_line() {
        for (text, line) in [
            ("a plain text, e\u{301}t\u{e9}, \u{6587}", "a plain text, e\u{301}t\u{e9}, \u{6587}"),
            ("one\r\ntwo\u{85}\u{2028}\u{1b}[31m", "one  two   [31m"),
            ("\u{202e}gpj.exe\u{2066}", "\u{fffd}gpj.exe\u{fffd}"),
            ("a\u{200b}b\u{feff}\u{e0041}\u{3164}", "a\u{fffd}b\u{fffd}\u{fffd}\u{fffd}"),
        ] {
            assert_eq!(one_line(text), line, "{text:?}");
        }
    }
}
