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
    HttpResponse::Ok()
        .content_type(file_extension_to_mime(extension))
        .body(*text)
}
