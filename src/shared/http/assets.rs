//! Style sheets, scripts and images of the pages, which are embedded in the program.

use actix_files::file_extension_to_mime;
use actix_web::{HttpRequest, HttpResponse};

/// A file that pages refer to as `assets/NAME`: its name and its content. The extension determines the type.
pub type Asset = (&'static str, &'static str);

/// Embeds a file of `templates/assets` at build time.
#[macro_export]
macro_rules! asset {
    ($name:literal) => {
        ($name, include_str!(concat!("../../../templates/assets/", $name)))
    };
}

/// Assets that pages of both servers use: of each page, of live pages, and of the viewers.
pub const COMMON: &[Asset] = &[
    asset!("theme.css"),
    asset!("style.css"),
    asset!("icon.svg"),
    asset!("live.js"),
    asset!("server_events.js"),
    asset!("table.js"),
    asset!("times.js"),
    asset!("dom.js"),
    asset!("language.js"),
    asset!("intl.js"),
    asset!("english.js"),
    asset!("german.js"),
    asset!("french.js"),
    asset!("spanish.js"),
    asset!("chinese.js"),
    asset!("japanese.js"),
    asset!("simulation.css"),
    asset!("stream.js"),
    asset!("small_viewer.js"),
    asset!("scene.js"),
    asset!("shapes.js"),
    asset!("matrix.js"),
    asset!("camera.js"),
    asset!("draw.js"),
    asset!("webots_viewer.css"),
    asset!("webots_viewer.js"),
];

/// Answers a request for one of these files. Browsers fetch it again for each page.
pub fn answer(request: &HttpRequest, assets: &[Asset]) -> HttpResponse {
    let name = request.match_info().get("name").unwrap_or_default();
    let Some((_, text)) = assets.iter().chain(COMMON).find(|(known, _)| *known == name) else {
        return HttpResponse::NotFound().body("Error: there is no such file.");
    };
    let extension = name.rsplit('.').next().unwrap_or_default();
    let content = match extension {
        "js" | "css" => without_comments(text),
        _ => (*text).to_owned(),
    };
    HttpResponse::Ok()
        .content_type(file_extension_to_mime(extension))
        .body(content)
}

/// A script or style sheet without the comments that have lines of their own: these are a third of it, also once it is
/// compressed.
fn without_comments(text: &str) -> String {
    let mut code = String::with_capacity(text.len());
    let mut is_comment = false;
    for line in text.lines() {
        let trimmed = line.trim();
        let begins = !is_comment && trimmed.starts_with("/*");
        let rest = if is_comment || begins {
            is_comment = true;
            trimmed.split_once("*/").map(|(_, rest)| rest)
        } else {
            Some(line).filter(|_| !trimmed.starts_with("//"))
        };
        if let Some(rest) = rest {
            is_comment = false;
            if !rest.trim().is_empty() {
                code.push_str(rest);
                code.push('\n');
            }
        }
    }
    code
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_on_their_own_lines_are_left_out_and_code_is_not() {
        let text = "// One.\nlet a = 1; // stays\n\n/** Two,\n * more */\nlet b = '/* no */';\n  /** @type {X} */ (a).b();\n/* three\n*/ c();\n";
        let code = "let a = 1; // stays\nlet b = '/* no */';\n (a).b();\n c();\n";
        assert_eq!(without_comments(text), code);
    }
}
