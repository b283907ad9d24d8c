//! Style sheets, scripts and images of the pages, which are embedded in the program.

use std::hash::{DefaultHasher, Hash, Hasher};

use actix_web::http::header::{self, EntityTag, Header, IfNoneMatch};
use actix_web::{HttpRequest, HttpResponse};

/// A file that pages refer to as `assets/NAME`.
#[derive(Debug, Clone, Copy)]
pub struct Asset {
    /// Its file name; the extension determines its type.
    pub name: &'static str,
    /// Its content.
    pub text: &'static str,
}

/// Embeds a file of `templates/assets` at build time.
#[macro_export]
macro_rules! asset {
    ($name:literal) => {
        $crate::shared::http::assets::Asset {
            name: $name,
            text: include_str!(concat!("../../../templates/assets/", $name)),
        }
    };
}

/// Assets that pages of both servers use: of each page, of live pages, and of the viewers.
pub const COMMON: &[Asset] = &[
    asset!("style.css"),
    asset!("icon.svg"),
    asset!("live.js"),
    asset!("times.js"),
    asset!("viewer.css"),
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

impl Asset {
    fn media_type(self) -> &'static str {
        match self.name.rsplit_once('.') {
            Some((_, "css")) => "text/css; charset=utf-8",
            Some((_, "js")) => "text/javascript; charset=utf-8",
            Some((_, "svg")) => "image/svg+xml",
            _ => "text/plain; charset=utf-8",
        }
    }

    fn tag(self) -> EntityTag {
        let mut hasher = DefaultHasher::new();
        self.text.hash(&mut hasher);
        EntityTag::new_strong(format!("{:016x}", hasher.finish()))
    }
}

/// Answers a request for one of these files. Browsers may cache it, and must revalidate it each time.
pub fn answer(request: &HttpRequest, assets: &[Asset]) -> HttpResponse {
    let name = request.match_info().get("name").unwrap_or_default();
    let Some(asset) = assets.iter().chain(COMMON).find(|asset| asset.name == name) else {
        return HttpResponse::NotFound().body("Error: there is no such file.");
    };
    let tag = asset.tag();
    let known = match IfNoneMatch::parse(request) {
        Ok(IfNoneMatch::Any) => true,
        Ok(IfNoneMatch::Items(tags)) => tags.iter().any(|one| one.weak_eq(&tag)),
        Err(_) => false,
    };
    let mut response = if known { HttpResponse::NotModified() } else { HttpResponse::Ok() };
    response.insert_header(header::ETag(tag)).insert_header((header::CACHE_CONTROL, "no-cache"));
    response.insert_header((header::X_CONTENT_TYPE_OPTIONS, "nosniff"));
    if known { response.finish() } else { response.content_type(asset.media_type()).body(asset.text) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use actix_web::body::MessageBody;
    use actix_web::test::TestRequest;

    fn ask(name: &str, tag: Option<&str>) -> HttpResponse {
        let mut request = TestRequest::default().param("name", name.to_owned());
        if let Some(tag) = tag {
            request = request.insert_header((header::IF_NONE_MATCH, tag.to_owned()));
        }
        answer(&request.to_http_request(), &[])
    }

    #[test]
    fn a_file_is_sent_once() {
        let first = ask("style.css", None);
        assert_eq!(first.headers().get(header::CONTENT_TYPE).unwrap(), "text/css; charset=utf-8");
        let tag = first.headers().get(header::ETAG).unwrap().to_str().unwrap().to_owned();
        let second = ask("style.css", Some(&tag));
        assert_eq!(second.status(), 304);
        assert!(second.into_body().try_into_bytes().unwrap().is_empty());
        assert_eq!(ask("style.css", Some("\"other\"")).status(), 200);
    }

    #[test]
    fn nothing_else_is_sent() {
        for name in ["", "../style.css", "style.css/", "mail.txt"] {
            assert_eq!(ask(name, None).status(), 404, "{name:?}");
        }
    }
}
