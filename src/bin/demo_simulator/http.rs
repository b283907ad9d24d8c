//! The simulator's port: WebSockets at `/`, and files of the world's project at any other path.

use std::path::{Component, Path, PathBuf};

use actix::Recipient;
use actix_files::NamedFile;
use actix_web::http::header;
use actix_web::{Error, HttpRequest, HttpResponse, web};
use actix_web_actors::ws;
use percent_encoding::percent_decode_str;

use crate::client::{Client, Event};

/// The extensions of the files that are served: what a client needs to draw a scene.
const EXTENSIONS: [&str; 11] = [
    "png", "jpg", "jpeg", "ico", "html", "css", "js", "dae", "obj", "mtl", "stl",
];
const NOT_FOUND: &str = include_str!("../../../templates/demo/not_found.html");

/// The directory whose files are served, without symlinks.
#[derive(Clone, Debug)]
pub(crate) struct ProjectFolder(PathBuf);

impl ProjectFolder {
    /// Serves files of `folder`; none if there is no such directory.
    pub(crate) fn new(folder: &Path) -> Self {
        Self(folder.canonicalize().unwrap_or_else(|_| PathBuf::from("/dev/null")))
    }

    /// Returns the file at a request's path, if there is one and it may be served. Blocks.
    fn file(&self, path: &str) -> Option<PathBuf> {
        let path = percent_decode_str(path.trim_start_matches('/')).decode_utf8().ok()?;
        let path = Path::new(path.as_ref());
        if !path.components().all(|part| matches!(part, Component::Normal(_))) {
            return None;
        }
        // symlinks must not resolve to a path outside the directory
        let file = self.0.join(path).canonicalize().ok()?;
        let extension = file.extension()?.to_str()?.to_ascii_lowercase();
        let is_allowed = EXTENSIONS.contains(&extension.as_str());
        (is_allowed && file.starts_with(&self.0) && file.is_file()).then_some(file)
    }
}

/// Adds the routes to an application.
pub(crate) fn configure(app: &mut web::ServiceConfig) {
    app.route("/", web::get().to(open_websocket))
        .default_service(web::get().to(send_file));
}

async fn open_websocket(
    request: HttpRequest,
    body: web::Payload,
    simulation: web::Data<Recipient<Event>>,
) -> Result<HttpResponse, Error> {
    ws::start(Client::new(simulation.get_ref().clone()), &request, body)
}

async fn send_file(request: HttpRequest, project: web::Data<ProjectFolder>) -> HttpResponse {
    let path = request.path().to_owned();
    let found = web::block(move || project.file(&path).and_then(|path| NamedFile::open(path).ok())).await;
    let Ok(Some(file)) = found else {
        return HttpResponse::NotFound()
            .insert_header((header::ACCESS_CONTROL_ALLOW_ORIGIN, "*"))
            .content_type("text/html; charset=utf-8")
            .body(NOT_FOUND);
    };
    let mut response = file
        .use_last_modified(false)
        .disable_content_disposition()
        .into_response(&request);
    let headers = response.headers_mut();
    headers.insert(
        header::ACCESS_CONTROL_ALLOW_ORIGIN,
        header::HeaderValue::from_static("*"),
    );
    headers.insert(
        header::CACHE_CONTROL,
        header::HeaderValue::from_static("public, max-age=3600"),
    );
    response
}
