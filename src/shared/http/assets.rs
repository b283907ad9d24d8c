//! Style sheets, scripts and images of the pages, which are embedded in the program.

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
}

/// Answers a request for one of these files. Browsers fetch it again for each page.
pub fn answer(request: &HttpRequest, assets: &[Asset]) -> HttpResponse {
    let name = request.match_info().get("name").unwrap_or_default();
    match assets.iter().chain(COMMON).find(|asset| asset.name == name) {
        Some(asset) => HttpResponse::Ok().content_type(asset.media_type()).body(asset.text),
        None => HttpResponse::NotFound().body("Error: there is no such file."),
    }
}
