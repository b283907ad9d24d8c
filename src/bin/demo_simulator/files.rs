//! Files of the world's project, as Webots serves them: at the path of a request, without a check of `..`; the pages of
//! robot windows without the folder `plugins`.

use std::fs;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::{Path, PathBuf};

use percent_encoding::percent_decode_str;

const NOT_FOUND: &str = include_str!("../../../templates/demo/not_found.html");

/// An answer to a request for a file.
pub(crate) struct Answer {
    /// The whole answer: head and body.
    pub(crate) bytes: Vec<u8>,
    /// A warning for the console.
    pub(crate) warning: Option<String>,
}

/// Answers a request for a file of `project`, whose head, or the first segment of it, is `head`. Blocks.
pub(crate) fn answer(project: &Path, head: &str) -> Answer {
    let mut words = head.split_ascii_whitespace();
    let url = words.nth(1).unwrap_or_default().trim_start_matches('/');
    let header = |name| head.split_ascii_whitespace().skip_while(|word| *word != name).nth(1);
    let path = percent_decode_str(url.split('?').next().unwrap_or_default()).decode_utf8_lossy();
    let Some(content_type) = content_type(&path) else {
        return not_found(Some(format!("Unsupported file type '/{path}'.")));
    };
    // An absolute path would replace the project's: Webots concatenates texts.
    let folder = if path.starts_with("robot_windows/") {
        "/plugins"
    } else {
        ""
    };
    let file = PathBuf::from(format!("{}{folder}/{path}", project.display()));
    let Ok(mut content) = fs::read(&file) else {
        let is_of_webots = ["js", "css", "html"]
            .iter()
            .any(|end| path.ends_with(&format!(".{end}")));
        let warning = is_of_webots.then(|| format!("Cannot read '{path}', sending \"404 Not Found\"."));
        return not_found(warning);
    };
    let host = header("Host:");
    if let Ok(text) = std::str::from_utf8(&content) {
        let own = format!("http://{}/", host.unwrap_or_default());
        content = text.replace("webots://", &own).into_bytes();
    }
    let etag = etag(&content);
    let is_known = header("If-None-Match:") == Some(&etag);
    let mut bytes = format!(
        "HTTP/1.1 {}\r\nAccess-Control-Allow-Origin: *\r\nCache-Control: public, max-age=3600\r\netag: {etag}\r\n",
        if is_known { "304 Not modified" } else { "200 OK" }
    )
    .into_bytes();
    if is_known {
        bytes.extend(b"\r\n");
    } else {
        let rest = format!(
            "Content-Type: {content_type}\r\nContent-Length: {}\r\n\r\n",
            content.len()
        );
        bytes.extend(rest.into_bytes());
        bytes.extend(content);
    }
    Answer {
        bytes,
        warning: host.is_none().then(|| "No host specified in HTTP header.".to_owned()),
    }
}

fn not_found(warning: Option<String>) -> Answer {
    let head = "HTTP/1.1 404 Not Found\r\nAccess-Control-Allow-Origin: *\r\nContent-Type: text/html";
    let bytes = format!("{head}\r\nContent-Length: {}\r\n\r\n{NOT_FOUND}", NOT_FOUND.len()).into_bytes();
    Answer { bytes, warning }
}

/// The type of a file by its extension; `None` if Webots serves no such files.
fn content_type(path: &str) -> Option<&'static str> {
    let (_, extension) = path.rsplit_once('.')?;
    Some(match extension.to_ascii_lowercase().as_str() {
        "png" => "image/png",
        "jpg" => "image/jpg",
        "jpeg" => "image/jpeg",
        "ico" => "image/ico",
        "html" => "text/html",
        "css" => "text/css",
        "js" => "application/javascript",
        "dae" => "model/vnd.collada+xml",
        "obj" => "model/obj",
        "mtl" => "model/mtl",
        "stl" => "model/stl",
        _ => return None,
    })
}

/// Identifies a content; Webots uses its MD5 sum.
fn etag(content: &[u8]) -> String {
    let mut hasher = DefaultHasher::new();
    content.hash(&mut hasher);
    format!("{:016x}", hasher.finish())
}
