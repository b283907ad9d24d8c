//! Routes of the simulation server's page, with its assets and event stream, and of Webots' own viewer.

use std::collections::BTreeMap;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use actix_files::NamedFile;
use actix_web::http::header::{self, HeaderValue};
use actix_web::{HttpRequest, HttpResponse, web};
use serde::Deserialize;

use super::pages::{self, Reader};
use super::queries::{snapshot, too_busy};
use super::webots_viewer;
use crate::asset;
use crate::shared::http::assets::{self, Asset};
use crate::shared::http::routing::{GET, READ, path};
use crate::shared::http::{AuthError, ConnectionKind, ContentSecurityPolicy, html, is_administrator};
use crate::simulation::container;
use crate::simulation::ends::output_file;
use crate::simulation::machine::{Tree, Usages};
use crate::simulation::snapshot::{Simulation, Snapshot};
use crate::simulation::state::AppState;

/// Assets of this server's page, besides those of all pages.
const ASSETS: &[Asset] = &[
    asset!("charts.css"),
    asset!("charts.js"),
    asset!("chart.js"),
    asset!("simulation_monitor.js"),
    asset!("watch.js"),
];
/// How much of an output's end is shown, in bytes: all that is kept of one that has ended, with its events.
const LARGEST_TAIL: u64 = 96 * 1024;

/// Adds the routes to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/monitor", READ, monitor))
        .service(path("/events", GET, events))
        .service(path("/history", GET, history))
        .service(path("/output", GET, output))
        .service(path("/assets/{name}", READ, asset))
        .service(path("/wwi/{path:.*}", GET, wwi));
}

/// Who sees a page, as far as the password tells.
fn reader(request: &HttpRequest, server: &AppState) -> Result<Reader, AuthError> {
    let peer = server.config.trusted_proxies.peer(request);
    Ok(match &server.admin_auth {
        None => Reader::Anybody,
        auth if is_administrator(auth.as_ref(), request, peer)? => Reader::Administrator,
        Some(_) => Reader::Stranger,
    })
}

async fn monitor(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    let Some(snapshot) = snapshot(&server).await else {
        return too_busy();
    };
    let usages = usages(&server, &snapshot).await;
    match reader(&request, &server) {
        Ok(reader) => html(pages::monitor(&server, &snapshot, &usages, reader), &ContentSecurityPolicy::own()),
        Err(refused) => refused.answer(),
    }
}

async fn usages(server: &AppState, snapshot: &Snapshot) -> Usages {
    let (usage, simulations) = (server.usage.clone(), snapshot.simulations.iter());
    let read = if let Some(containers) = &server.containers {
        // The process is `docker`, which waits for the containers.
        let roots: BTreeMap<u16, i32> = simulations.filter_map(|one| Some((one.port?, one.pid?))).collect();
        let owner = containers.run().clone();
        let read =
            move || usage.read_by(&roots.values().copied().collect::<Vec<_>>(), || container::measure(&owner, &roots));
        actix_rt::task::spawn_blocking(read)
    } else {
        let tree = |one: &Simulation| Some(Tree { root: one.pid?, cgroup: one.cgroup.clone() });
        let trees: Vec<Tree> = simulations.filter_map(tree).collect();
        actix_rt::task::spawn_blocking(move || usage.read(&trees))
    };
    read.await.unwrap_or_default()
}

async fn events(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    let permit = match server.connections.admit(ConnectionKind::Page, server.config.trusted_proxies.peer(&request)) {
        Ok(permit) => permit,
        Err(refused) => return refused.answer(),
    };
    let seen_by = match reader(&request, &server) {
        Ok(reader) => reader,
        Err(refused) => return refused.answer(),
    };
    let shown = server.clone();
    let render = move || {
        let server = shown.clone();
        async move {
            let snapshot = snapshot(&server).await?;
            let usages = usages(&server, &snapshot).await;
            let view = pages::view(&server, &snapshot, &usages, seen_by);
            view.inspect_err(|error| log::error!("the monitor page can't be rendered: {error}")).ok()
        }
    };
    let live = if seen_by == Reader::Administrator { &server.administrators } else { &server.live };
    live.listen(permit, server.phase.clone(), render)
}

async fn history(server: web::Data<AppState>) -> HttpResponse {
    let readings = server.readings.borrow().clone();
    HttpResponse::Ok().json(pages::history(&readings))
}

async fn asset(request: HttpRequest) -> HttpResponse {
    assets::answer(&request, ASSETS)
}

#[derive(Deserialize)]
struct Which {
    id: String,
}

/// The last output lines of a simulation, running or ended. They may be private, so the administrator's password
/// protects them if one is configured. Without it they name no port that only the relay of streams should reach.
async fn output(request: HttpRequest, which: web::Query<Which>, server: web::Data<AppState>) -> HttpResponse {
    if let Some(auth) = &server.admin_auth
        && let Err(refused) = auth.check(&request, server.config.trusted_proxies.peer(&request))
    {
        return refused.answer();
    }
    let logs = server.config.log_dir.0.join("simulation");
    let tail = web::block(move || output_file(&logs, &which.id).and_then(|file| tail(&file).ok())).await;
    let Ok(Some(tail)) = tail else {
        return HttpResponse::NotFound().body("Error: nothing is kept of this simulation.");
    };
    let has_ports = server.admin_auth.is_some() || server.config.ports_are_public();
    let tail = if has_ports { tail } else { without_ports(&tail) };
    HttpResponse::Ok()
        .insert_header((header::X_CONTENT_TYPE_OPTIONS, "nosniff"))
        .insert_header((header::CONTENT_SECURITY_POLICY, "default-src 'none'; frame-ancestors 'none'"))
        .content_type("text/plain; charset=utf-8")
        .body(tail)
}

/// The text without the numbers of ports, as events and Webots write them: `port 2001`.
fn without_ports(text: &str) -> String {
    let mut parts = text.split("port ");
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |text, part| {
        let rest = part.trim_start_matches(|one: char| one.is_ascii_digit());
        text + "port " + if rest.len() < part.len() { "..." } else { "" } + rest
    })
}

/// The last whole lines of a file.
fn tail(path: &Path) -> std::io::Result<String> {
    let mut file = std::fs::File::open(path)?;
    let skipped = file.metadata()?.len().saturating_sub(LARGEST_TAIL);
    file.seek(SeekFrom::Start(skipped))?;
    let mut bytes = Vec::new();
    file.take(LARGEST_TAIL).read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    let whole = if skipped > 0 { text.split_once('\n').map_or("", |(_, rest)| rest) } else { &text };
    Ok(whole.to_owned())
}

/// A file of Webots' own viewer.
async fn wwi(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    let path = request.match_info().query("path").to_owned();
    let file = web::block(move || {
        let file = webots_viewer::file_below(&webots_viewer::folder(&server.config)?, &path)?;
        NamedFile::open(file).ok()
    });
    let Ok(Some(file)) = file.await else {
        return HttpResponse::NotFound().body("Error: there is no such file.");
    };
    let mut response = file.disable_content_disposition().into_response(&request);
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    response.headers_mut().insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    response
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn ports_are_left_out() {
        for (text, shown) in [
            ("12:00:00 port 2001: ready\nport 2002", "12:00:00 port ...: ready\nport ..."),
            ("support 2001", "support ..."),
            ("an export in 2026", "an export in 2026"),
            ("port is 7", "port is 7"),
            ("", ""),
        ] {
            assert_eq!(without_ports(text), shown, "{text}");
        }
    }

    #[test]
    fn only_the_end_of_an_output_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("1.log");
        fs::write(&path, "a short one\n").unwrap();
        assert_eq!(tail(&path).unwrap(), "a short one\n");
        fs::write(&path, "a line of the flood\n".repeat(10_000)).unwrap();
        let end = tail(&path).unwrap();
        assert!(end.len() as u64 <= LARGEST_TAIL && end.starts_with("a line"), "{}", end.len());
    }
}
