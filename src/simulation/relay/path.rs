//! The path of a stream, `/stream/TOKEN/...`. Pure.

use percent_encoding::percent_decode_str;

use crate::simulation::attachment::Token;

/// Prefix of each stream's path.
const PREFIX: &str = "/stream/";

/// Splits a path, as the client has sent it, into the token and the path for Webots. `None` if either is invalid.
pub fn parse_path(path: &str) -> Option<(Token, &str)> {
    let rest = path.strip_prefix(PREFIX)?;
    let (token, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
    let token = Token::parse(token)?;
    match path.strip_prefix('/') {
        None | Some("") => Some((token, "/")),
        Some(inside) => inside.split('/').all(is_safe_segment).then_some((token, path)),
    }
}

/// Whether a segment of a path is a plain name, even if it is decoded twice: a percent sign is not allowed.
fn is_safe_segment(part: &str) -> bool {
    let Ok(name) = percent_decode_str(part).decode_utf8() else {
        return false;
    };
    let is_plain = !name.contains(|letter: char| letter.is_control() || matches!(letter, '/' | '\\' | '%'));
    is_plain && !matches!(name.as_ref(), "" | "." | "..")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_below_the_token_is_passed_on() {
        let token = Token::random();
        let path = |rest: &str| format!("/stream/{}{rest}", token.reveal());
        for (rest, passed) in [
            ("", Some("/")),
            ("/", Some("/")),
            ("/worlds/textures/a.png", Some("/worlds/textures/a.png")),
            ("/~WEBOTS_HOME/a%20b.js", Some("/~WEBOTS_HOME/a%20b.js")),
            ("/100%25.png", None),
            ("/a/../b", None),
            ("/..", None),
            ("/./a", None),
            ("/a//b", None),
            ("//evil.example/", None),
            ("/a/", None),
            ("/%2e%2e/b", None),
            ("/.%2E/b", None),
            ("/%252e%252e/b", None),
            ("/a%2fb", None),
            ("/a%252fb", None),
            ("/a%5cb", None),
            ("/a\\b", None),
            ("/a%00", None),
            ("/a%0d%0aHost:x", None),
            ("/%ff", None),
        ] {
            let path = path(rest);
            assert_eq!(parse_path(&path), passed.map(|passed| (token, passed)), "{rest}");
        }
        for path in [
            "/stream/",
            "/stream//a",
            "/stream/x/a",
            "/streams/x",
            "/",
            &path("x/a"),
            &format!("/x{}", path("/a")),
        ] {
            assert_eq!(parse_path(path), None, "{path}");
        }
    }
}
