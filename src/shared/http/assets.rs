//! Style sheets, scripts and images of the pages, which are embedded in the program.

use std::io::Write;
use std::sync::LazyLock;

use actix_files::file_extension_to_mime;
use actix_web::http::header::{self, AcceptEncoding, Encoding};
use actix_web::web::Bytes;
use actix_web::{HttpMessage, HttpRequest, HttpResponse};
use flate2::Compression;
use flate2::write::GzEncoder;

/// A file that pages refer to as `assets/NAME`. The extension determines the type.
pub struct Asset {
    name: &'static str,
    content: LazyLock<Content>,
}

impl Asset {
    /// An asset whose content is made at its first request.
    pub const fn new(name: &'static str, content: fn() -> Content) -> Self {
        Self {
            name,
            content: LazyLock::new(content),
        }
    }

    /// Answers a request for it.
    pub fn answer(&self, request: &HttpRequest) -> HttpResponse {
        let mut response = HttpResponse::Ok();
        response
            .content_type(file_extension_to_mime(extension(self.name)))
            .insert_header((header::VARY, "Accept-Encoding"));
        if accepts_gzip(request) {
            response
                .insert_header((header::CONTENT_ENCODING, "gzip"))
                .body(self.content.gzip.clone())
        } else {
            response.body(self.content.plain.clone())
        }
    }
}

/// What is sent: the same for all requests.
pub struct Content {
    plain: Bytes,
    gzip: Bytes,
}

impl Content {
    /// The content of a file. Scripts and style sheets are sent without their comments.
    pub fn new(name: &str, text: &'static str) -> Self {
        let plain = match extension(name) {
            "js" | "css" => without_comments(text).into(),
            _ => Bytes::from_static(text.as_bytes()),
        };
        Self::of(plain)
    }

    /// Modules as one script: a browser asks once, not once for each that another imports. Each comes after those that it
    /// imports, all have different names at their top level, and only the last exports anything.
    pub fn joined(modules: &[&str]) -> String {
        let mut script = String::new();
        for (number, module) in modules.iter().enumerate() {
            let mut is_import = false;
            for line in without_comments(module).lines() {
                is_import |= line.starts_with("import ");
                if !is_import {
                    let is_last = number + 1 == modules.len();
                    let own = line.strip_prefix("export ").filter(|_| !is_last).unwrap_or(line);
                    script.push_str(own);
                    script.push('\n');
                }
                is_import &= !line.ends_with(';');
            }
        }
        script
    }

    /// A module that exports these style sheets.
    pub fn style_module(sheets: &[&str]) -> String {
        let styles: String = sheets.iter().map(|sheet| without_comments(sheet)).collect();
        format!("export const styles = {};\n", serde_json::Value::from(styles))
    }

    /// A content that is sent as it is.
    pub fn of(plain: Bytes) -> Self {
        let gzip = compressed(&plain);
        Self { plain, gzip }
    }
}

/// Embeds a file of `templates/assets` at build time.
#[macro_export]
macro_rules! asset {
    ($name:literal) => {
        $crate::shared::http::assets::Asset::new($name, || {
            $crate::shared::http::assets::Content::new(
                $name,
                include_str!(concat!("../../../templates/assets/", $name)),
            )
        })
    };
}

/// The words of a language, with the formats that they use.
macro_rules! language {
    ($name:literal) => {
        Asset::new($name, || {
            let formats = include_str!("../../../templates/assets/intl.js");
            let words = include_str!(concat!("../../../templates/assets/", $name));
            Content::of(Content::joined(&[formats, words]).into())
        })
    };
}

/// Assets that pages of both servers use: of each page, of live pages, and of the viewers.
static COMMON: [Asset; 25] = [
    asset!("theme.css"),
    asset!("style.css"),
    asset!("icon.svg"),
    asset!("live.js"),
    asset!("server_events.js"),
    asset!("table.js"),
    asset!("times.js"),
    asset!("dom.js"),
    asset!("language.js"),
    language!("english.js"),
    language!("german.js"),
    language!("french.js"),
    language!("spanish.js"),
    language!("chinese.js"),
    language!("japanese.js"),
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
    assets
        .iter()
        .chain(&COMMON)
        .find(|asset| asset.name == name)
        .map_or_else(
            || HttpResponse::NotFound().body("Error: there is no such file."),
            |asset| asset.answer(request),
        )
}

/// Whether the client of a request can read an answer that is compressed by gzip.
pub fn accepts_gzip(request: &HttpRequest) -> bool {
    let known = [Encoding::gzip(), Encoding::identity()];
    let accepted = request.get_header::<AcceptEncoding>();
    accepted.and_then(|accepted| accepted.negotiate(known.iter())) == Some(Encoding::gzip())
}

fn extension(name: &str) -> &str {
    name.rsplit('.').next().unwrap_or_default()
}

/// Compresses by gzip. Writing to memory does not fail; otherwise it would be empty.
fn compressed(text: &[u8]) -> Bytes {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    let written = encoder.write_all(text).and_then(|()| encoder.finish());
    written.unwrap_or_default().into()
}

/// A script or style sheet without the comments that have lines of their own, and without empty lines: these are a third
/// of it, also once it is compressed. It reads no strings: a test checks that no text has several lines.
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
    use actix_web::test::TestRequest;

    use super::*;

    #[test]
    fn comments_on_their_own_lines_are_left_out_and_code_is_not() {
        let text = "// One.\nlet a = 1; // stays\n\n/** Two,\n * more */\nlet b = '/* no */';\n  /** @type {X} */ (a).b();\n/* three\n*/ c();\n";
        let code = "let a = 1; // stays\nlet b = '/* no */';\n (a).b();\n c();\n";
        assert_eq!(without_comments(text), code);
    }

    /// The first line with what could be damaged: a comment that begins after code and goes on in the next line, or a
    /// template literal over several lines, which may have lines that are empty or look like comments.
    fn damaged(script: &str) -> Option<String> {
        let code = without_comments(script);
        let could_be = |line: &&str| line.rfind("/*") > line.rfind("*/") || line.matches('`').count() % 2 == 1;
        code.lines().find(could_be).map(str::to_owned)
    }

    #[test]
    fn no_script_is_damaged_when_its_comments_are_left_out() {
        assert!(damaged("a = 1; /* one\n// two */ b = 2;").is_some());
        assert!(damaged("a = `one\n\n// two`;").is_some());
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/templates/assets");
        let paths = std::fs::read_dir(folder).unwrap().map(|file| file.unwrap().path());
        // In the shaders of draw.js, these lines are comments too.
        for path in paths.filter(|path| !path.ends_with("draw.js")) {
            let text = std::fs::read_to_string(&path).unwrap();
            assert_eq!(damaged(&text), None, "{}", path.display());
        }
    }

    #[test]
    fn joined_modules_import_nothing_of_each_other_and_export_what_the_last_exports() {
        let one = "// One.\nexport const a = 1;\nexport function b() {\n  return import('./d.js');\n}\n";
        let two = "import { a } from './one.js';\nimport {\n  b,\n} from './one.js';\n\nexport const c = a + b();\n";
        let script = "const a = 1;\nfunction b() {\n  return import('./d.js');\n}\nexport const c = a + b();\n";
        assert_eq!(Content::joined(&[one, two]), script);
    }

    #[test]
    fn who_can_read_it_gets_it_compressed() {
        let text = "let a = 1;\n".repeat(100);
        let mut unpacked = Vec::new();
        flate2::write::GzDecoder::new(&mut unpacked)
            .write_all(&compressed(text.as_bytes()))
            .unwrap();
        assert_eq!(unpacked, text.as_bytes());
        for (accepted, is_read) in [
            (Some("gzip, deflate, br"), true),
            (Some("gzip;q=0, br"), false),
            (Some("identity"), false),
            (None, false),
        ] {
            let mut request = TestRequest::default();
            if let Some(accepted) = accepted {
                request = request.insert_header((header::ACCEPT_ENCODING, accepted));
            }
            assert_eq!(accepts_gzip(&request.to_http_request()), is_read, "{accepted:?}");
        }
    }
}
