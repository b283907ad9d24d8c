//! Makes untrusted text safe to show. Pure.

use icu_properties::props::{BinaryProperty, DefaultIgnorableCodePoint};

/// Longest name of a client, in characters.
const MAX_NAME: usize = 60;
/// Longest name of a user, in characters.
const MAX_USER: usize = 200;

/// Returns a text without line breaks, terminal control sequences, direction marks and invisible characters.
///
/// Control characters become spaces. Invisible characters, including direction marks, become U+FFFD.
pub fn one_line(text: &str) -> String {
    let visible = |letter: char| match letter {
        // The fast path: most characters need no lookup in Unicode's tables.
        ' '..='~' => letter,
        '\u{2028}' | '\u{2029}' => ' ',
        letter if letter.is_control() => ' ',
        letter if DefaultIgnorableCodePoint::for_char(letter) => char::REPLACEMENT_CHARACTER,
        letter => letter,
    };
    text.chars().map(visible).collect()
}

/// The name that a client has chosen, as one short line; `None` if nothing is left of it.
pub fn chosen_name(text: &str) -> Option<String> {
    let name: String = one_line(text).trim().chars().take(MAX_NAME).collect();
    (!name.is_empty()).then_some(name)
}

/// The name of a user, as one line; `None` if nothing is left of it.
pub fn user_name(text: &str) -> Option<String> {
    let name: String = one_line(text).trim().chars().take(MAX_USER).collect();
    (!name.is_empty()).then_some(name)
}

/// Returns a text as one line of at most `most` characters, with `...` if it was cut.
pub fn excerpt(text: &str, most: usize) -> String {
    let mut excerpt: String = one_line(text).chars().take(most).collect();
    if text.chars().nth(most).is_some() {
        excerpt.push_str("...");
    }
    excerpt
}

/// Quotes around a path in a text.
const QUOTES: [char; 3] = ['\'', '"', '`'];
/// Characters that end a path in a text, besides white space.
const PATH_ENDS: &str = "'\"`,;:<>|";

/// Returns a text for a web client in one line, without characters that begin a tag or a character reference of HTML.
///
/// Webots' page inserts such texts into `innerHTML`. Other clients show them verbatim, so the characters are replaced
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

/// Returns a text in which each absolute path is cut to its last component. URLs and relative paths stay unchanged.
///
/// Texts for web clients pass through this: the paths of a machine are of no use to them.
pub fn without_paths(text: &str) -> String {
    let mut result = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find('/') {
        let (before, from) = rest.split_at(at);
        // A quoted path may contain spaces.
        let quote = before.chars().next_back().filter(|letter| QUOTES.contains(letter));
        let ends = |letter: char| letter.is_whitespace() || PATH_ENDS.contains(letter);
        let end = quote
            .and_then(|quote| from.find(quote))
            .or_else(|| from.find(ends))
            .unwrap_or(from.len());
        let (path, after) = from.split_at(end);
        result.push_str(before);
        let is_url = path.starts_with("//") && before.ends_with(':') && !before.ends_with("file:");
        let is_relative = before.ends_with(|letter: char| letter.is_alphanumeric() || ".-_~".contains(letter));
        if is_url || is_relative || path == "/" {
            result.push_str(path);
        } else {
            result.push_str(path.trim_end_matches(['/', '.']).rsplit('/').next().unwrap_or_default());
            result.push_str(path.get(path.trim_end_matches('.').len()..).unwrap_or_default());
        }
        rest = after;
    }
    result + rest
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
    fn paths_of_the_machine_are_cut_and_urls_are_not() {
        for (text, shown) in [
            (
                "can't write /var/cache/run/instance-a1: full",
                "can't write instance-a1: full",
            ),
            ("fatal: '/srv/git/arm.git' is none.", "fatal: 'arm.git' is none."),
            ("at \"/home/a b/c d/webots\". Set", "at \"webots\". Set"),
            (
                "file:/srv/git/arm.git and file:///srv/git/leg.git",
                "file:arm.git and file:leg.git",
            ),
            ("at /opt/webots/. Its --log=/a/b.", "at webots. Its --log=b."),
            ("PATH=/usr/bin:/bin", "PATH=bin:bin"),
            (
                "https://github.com/lab/arm/blob/main/worlds/a.wbt",
                "https://github.com/lab/arm/blob/main/worlds/a.wbt",
            ),
            (
                "ws://localhost:2000/client, worlds/a.wbt",
                "ws://localhost:2000/client, worlds/a.wbt",
            ),
            (
                "controllers/arm/arm.py, ./a/b ../c and/or 3 / 4",
                "controllers/arm/arm.py, ./a/b ../c and/or 3 / 4",
            ),
            ("Step 3/9 : fetching", "Step 3/9 : fetching"),
        ] {
            assert_eq!(without_paths(text), shown, "{text:?}");
        }
    }

    #[test]
    fn nothing_hides_in_a_line() {
        for (text, line) in [
            (
                "a plain text, e\u{301}t\u{e9}, \u{6587}",
                "a plain text, e\u{301}t\u{e9}, \u{6587}",
            ),
            ("one\r\ntwo\u{85}\u{2028}\u{1b}[31m", "one  two   [31m"),
            ("\u{202e}gpj.exe\u{2066}", "\u{fffd}gpj.exe\u{fffd}"),
            (
                "a\u{200b}b\u{feff}\u{e0041}\u{3164}",
                "a\u{fffd}b\u{fffd}\u{fffd}\u{fffd}",
            ),
        ] {
            assert_eq!(one_line(text), line, "{text:?}");
        }
    }
}
