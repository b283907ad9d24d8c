//! What the simulator's port answers over HTTP: the WebSocket at `/`, and the files of the world's project
//! at any other path.

use std::any::Any;
use std::net::TcpStream;
use std::os::fd::AsFd as _;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use actix::Recipient;
use actix_files::NamedFile;
use actix_web::dev::Extensions;
use actix_web::error::ErrorInternalServerError;
use actix_web::http::header;
use actix_web::rt::net;
use actix_web::{Error, HttpRequest, HttpResponse, web};
use actix_web_actors::ws;
use percent_encoding::percent_decode_str;

use crate::client::{Client, Event};

/// The extensions of the files that are given away: what a viewer needs to draw and to explain a scene.
const EXTENSIONS: [&str; 11] = ["png", "jpg", "jpeg", "ico", "html", "css", "js", "dae", "obj", "mtl", "stl"];
const NOT_FOUND: &str = include_str!("../../../templates/demo/not_found.html");

/// The folder of which files are given away, with its links resolved.
#[derive(Clone, Debug)]
pub(crate) struct ProjectFolder(PathBuf);

/// The connection that a request came on.
#[derive(Clone)]
struct Connection(Arc<TcpStream>);

impl ProjectFolder {
    /// Gives away files of `folder`; none if there is no such folder.
    pub(crate) fn new(folder: &Path) -> Self {
        Self(folder.canonicalize().unwrap_or_else(|_| PathBuf::from("/dev/null")))
    }

    /// The file that a request's path asks for, if it may be given away.
    fn file(&self, path: &str) -> Option<PathBuf> {
        let path = percent_decode_str(path.trim_start_matches('/')).decode_utf8().ok()?;
        let path = Path::new(path.as_ref());
        if !path.components().all(|part| matches!(part, Component::Normal(_))) {
            return None;
        }
        // once the links are resolved nothing of the request is left to trick with
        let file = self.0.join(path).canonicalize().ok()?;
        let extension = file.extension()?.to_str()?.to_ascii_lowercase();
        let is_allowed = EXTENSIONS.contains(&extension.as_str());
        (is_allowed && file.starts_with(&self.0) && file.is_file()).then_some(file)
    }
}

/// Keeps a second handle to each connection, by which it can be broken.
pub(crate) fn remember_connection(io: &dyn Any, data: &mut Extensions) {
    let handle = io.downcast_ref::<net::TcpStream>().and_then(|stream| stream.as_fd().try_clone_to_owned().ok());
    if let Some(handle) = handle {
        data.insert(Connection(Arc::new(handle.into())));
    }
}

/// Adds the simulator's paths to an application.
pub(crate) fn configure(app: &mut web::ServiceConfig) {
    app.route("/", web::get().to(open_client)).default_service(web::get().to(send_file));
}

async fn open_client(
    request: HttpRequest,
    body: web::Payload,
    simulation: web::Data<Recipient<Event>>,
) -> Result<HttpResponse, Error> {
    let Some(Connection(connection)) = request.conn_data::<Connection>().cloned() else {
        return Err(ErrorInternalServerError("the connection has no second handle"));
    };
    let simulation = simulation.get_ref().clone();
    ws::start(Client::new(simulation, connection), &request, body)
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
    let mut response = file.use_last_modified(false).disable_content_disposition().into_response(&request);
    let headers = response.headers_mut();
    headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, header::HeaderValue::from_static("*"));
    headers.insert(header::CACHE_CONTROL, header::HeaderValue::from_static("public, max-age=3600"));
    response
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn only_harmless_files_of_the_project_are_given_away() {
        let outside = tempfile::tempdir().unwrap();
        let project = outside.path().join("project");
        fs::create_dir_all(project.join("worlds/textures")).unwrap();
        for file in ["worlds/a.wbt", "worlds/textures/a b.PNG", "index.html", "../secret.png", "x.py"] {
            fs::write(project.join(file), "").unwrap();
        }
        symlink("../secret.png", project.join("leak.png")).unwrap();
        symlink("x.py", project.join("renamed.png")).unwrap();
        symlink("index.html", project.join("start.html")).unwrap();
        let folder = ProjectFolder::new(&project);
        for (path, found) in [
            ("/index.html", true),
            ("/start.html", true),
            ("/worlds/textures/a%20b.PNG", true),
            ("/worlds/a.wbt", false),
            ("/x.py", false),
            ("/renamed.png", false),
            ("/leak.png", false),
            ("/../secret.png", false),
            ("/%2e%2e/secret.png", false),
            ("/worlds/../index.html", false),
            ("//etc/passwd", false),
            ("/index.html%00.png", false),
            ("/%ff.png", false),
            ("/worlds", false),
            ("/missing.png", false),
        ] {
            assert_eq!(folder.file(path).is_some(), found, "{path}");
        }
    }
}
