//! The class: all simulations of the fleet and all who wait, for programs (`/simulations`) and as the page `/class`, whose
//! events have what has changed. Actions are forwarded to the simulation servers.

use std::convert::Infallible;
use std::io::Write;
use std::time::Duration;

use actix::Recipient;
use actix_rt::time::sleep;
use actix_web::error::{ErrorBadRequest, ErrorConflict, ErrorNotFound, ErrorServiceUnavailable};
use actix_web::http::header;
use actix_web::web::Bytes;
use actix_web::{HttpRequest, HttpResponse, Result, web};
use askama::Template;
use flate2::Compression;
use flate2::write::GzEncoder;
use futures_util::future::join_all;
use futures_util::stream::{self, StreamExt};
use serde::{Deserialize, Serialize};
use serde_json::json;
use serde_json::value::RawValue;

use crate::session::class::{Changes, ClassEntry, Key, Matching, Watching};
use crate::session::fleet::{FleetStatus, GetMonitors, GetRecords, ServerStatus, StateName};
use crate::session::state::AppState;
use crate::shared::domain::{ProjectUrl, PublicAddress, ReadyEntry, View};
use crate::shared::http::assets::accepts_gzip;
use crate::shared::http::routing::{GET, POST, READ, json_body, path};
use crate::shared::http::time_span::{TimeSpan, csv_file};
use crate::shared::http::{ConnectionKind, ConnectionPermit, OWN_FILES, html, sign_in};
use crate::shared::run::closing;
use crate::shared::text::one_line;

/// Interval between two looks at the list, for a page.
const PERIOD: Duration = Duration::from_millis(500);
/// Interval between two looks at the servers, in periods.
const SERVERS: u32 = 4;
/// Interval of empty events while nothing changes, in periods: they show a page that the server is alive.
const KEEP_ALIVE: u32 = 30;
/// Bytes that are written to a connection at once, so that a page that does not read costs little memory.
const CHUNK: usize = 8 * 1024;

/// The page.
#[derive(Template)]
#[template(path = "session/class.html")]
struct Class {
    /// Whether this server has the key of a fleet.
    has_fleet: bool,
}

/// Adds the routes to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/class", READ, class))
        .service(path("/class/events", GET, events))
        .service(path("/visit", GET, visit))
        .service(path("/simulations", READ, simulations))
        .service(path("/simulations.csv", GET, records))
        .service(path("/simulations/stop", POST, stop_many))
        .service(path("/simulations/{id}/stop", POST, stop));
}

async fn class(request: HttpRequest, server: web::Data<AppState>) -> HttpResponse {
    if let Err(error) = server.admin_auth.reader(&request) {
        return sign_in::refuse(error, &request, "class");
    }
    let has_fleet = server.config.fleet_key.is_some();
    html(Class { has_fleet }.render(), OWN_FILES)
}

async fn simulations(request: HttpRequest, server: web::Data<AppState>) -> Result<HttpResponse> {
    server.admin_auth.reader(&request)?;
    server.look_at_line().await;
    Ok(HttpResponse::Ok().json(server.roster.all()))
}

/// The records of a span of time, of all servers, in the order of their beginnings.
async fn records(
    request: HttpRequest,
    span: web::Query<TimeSpan>,
    server: web::Data<AppState>,
) -> Result<HttpResponse> {
    let administrator = server.admin_auth.reader(&request)?;
    let monitors = server.registry.send(GetMonitors).await;
    let monitors = monitors.map_err(|_| ErrorServiceUnavailable("Error: the server stops."))?;
    let order = GetRecords {
        query: span.query(),
        token: sign_in::reading_token(&server.admin_auth, administrator),
    };
    let fetch = |(address, monitor): (PublicAddress, Recipient<GetRecords>)| {
        let answer = monitor.send(order.clone());
        async { (address, answer.await) }
    };
    let (mut lines, mut missing) = (Vec::new(), Vec::new());
    let mut heading = String::new();
    for (address, answer) in join_all(monitors.into_iter().map(fetch)).await {
        let text = answer.ok().and_then(std::result::Result::ok);
        let Some((first, rest)) = text
            .as_deref()
            .and_then(|text| std::str::from_utf8(text).ok()?.split_once('\n'))
        else {
            log::warn!("{address}: has not sent its records");
            missing.push(address.to_string());
            continue;
        };
        heading = format!("{first},server\n");
        lines.extend(rest.lines().map(|line| format!("{line},{address}\n")));
    }
    lines.sort_by(|one, other| begin_of(one).cmp(begin_of(other)));
    let mut response = csv_file(&heading, &lines);
    if !missing.is_empty()
        && let Ok(missing) = header::HeaderValue::try_from(missing.join(", "))
    {
        let name = header::HeaderName::from_static("webots-missing");
        response.headers_mut().insert(name, missing);
    }
    Ok(response)
}

/// The second column.
fn begin_of(line: &str) -> &str {
    line.split(',').nth(1).unwrap_or_default()
}

/// The body of a request to stop simulations.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct StopMany {
    ids: Option<Vec<String>>,
    world: Option<String>,
    server: Option<String>,
    user: Option<String>,
    label: Option<String>,
    reason: String,
}

/// The body of a request to stop one.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct StopOne {
    reason: String,
}

async fn stop_many(request: HttpRequest, body: web::Payload, server: web::Data<AppState>) -> Result<HttpResponse> {
    const FORM: &str = "{\"ids\": [ID] or \"world\", \"server\", \"user\", \"label\": TEXT, \"reason\": TEXT}";
    let administrator = server.admin_auth.actor(&request)?;
    let order: StopMany = match json_body(&request, body, FORM).await {
        Ok(order) => order,
        Err(refusal) => return Ok(refusal),
    };
    let which = Matching {
        ids: order.ids,
        world: order.world,
        server: order.server,
        user: order.user,
        label: order.label,
    };
    if which.is_empty() {
        return Err(ErrorBadRequest(format!("Error: the body is not {FORM}.")));
    }
    let by = administrator.to_string();
    let (stopped, failed) = server.roster.stop(&which, &order.reason, &by).await;
    log::info!("{by}: stops {} simulations", stopped.len());
    Ok(HttpResponse::Accepted().json(json!({"stopped": stopped, "failed": failed})))
}

async fn stop(
    request: HttpRequest,
    id: web::Path<String>,
    body: web::Payload,
    server: web::Data<AppState>,
) -> Result<HttpResponse> {
    let administrator = server.admin_auth.actor(&request)?;
    let StopOne { reason } = match json_body(&request, body, "{\"reason\": TEXT}").await {
        Ok(order) => order,
        Err(refusal) => return Ok(refusal),
    };
    let id = id.into_inner();
    let servers = server.roster.servers_of(&id);
    if servers.len() > 1 {
        let servers: Vec<String> = servers.iter().map(ToString::to_string).collect();
        return Err(ErrorConflict(format!(
            "Error: several servers have a simulation with this id ({}); POST /simulations/stop with \"ids\" and \"server\" \
             stops one.",
            servers.join(", ")
        )));
    }
    let which = Matching {
        ids: Some(vec![id]),
        ..Matching::default()
    };
    let by = administrator.to_string();
    let (stopped, failed) = server.roster.stop(&which, &reason, &by).await;
    if stopped.is_empty() {
        let words = "Error: there is no such simulation; it may have ended, or its server does not answer.";
        return Err(ErrorNotFound(words));
    }
    log::info!("{by}: stops {}", stopped.join(", "));
    Ok(HttpResponse::Accepted().json(json!({"stopped": stopped, "failed": failed})))
}

/// Which page of a simulation server.
#[derive(Deserialize)]
struct Visit {
    server: Option<String>,
    id: Option<String>,
}

/// Leads the browser of an administrator to a simulation, or to the monitor of a simulation server, where it is signed in
/// then, too.
async fn visit(request: HttpRequest, which: web::Query<Visit>, server: web::Data<AppState>) -> Result<HttpResponse> {
    let administrator = match server.admin_auth.owner(&request) {
        Ok(administrator) => administrator,
        Err(error) => return Ok(sign_in::refuse(error, &request, "class")),
    };
    let nothing = || ErrorNotFound("Error: there is no such simulation or server; it may have ended.");
    let (address, to) = if let Some(id) = &which.id {
        let found = server.roster.server_of(id, which.server.as_deref());
        let address = found.ok_or_else(nothing)?;
        (address, format!("watch?id={id}"))
    } else {
        let status = server.status().await?;
        let is_it = |address: &&PublicAddress| Some(address.to_string()) == which.server;
        let mut known = status.servers.iter().map(|one| &one.record.address);
        (known.find(is_it).ok_or_else(nothing)?.clone(), "monitor".to_owned())
    };
    let page = match server.roster.run_of(&address) {
        Some(run) => format!(
            "sign-in?{}",
            sign_in::entry(&server.admin_auth, administrator, run, &to)
        ),
        None => to,
    };
    let url = format!("{}/{page}", server.client_urls.http_url(&address));
    Ok(HttpResponse::SeeOther().insert_header((header::LOCATION, url)).finish())
}

/// A simulation server, as the page shows it.
#[derive(Serialize)]
struct ServerLine {
    address: PublicAddress,
    /// The URL of its monitor.
    page: String,
    state: StateName,
    /// Why its simulations are not listed, or what is wrong with it.
    note: String,
    /// Number of its simulations, as it reports it.
    #[serde(skip_serializing_if = "Option::is_none")]
    simulations: Option<u32>,
}

fn server_lines(server: &AppState, status: &FleetStatus) -> Vec<ServerLine> {
    let line = |one: &ServerStatus| {
        let record = &one.record;
        let report = record.state.report();
        let note = if let Some(failure) = &one.failure {
            failure.in_full()
        } else if server.roster.is_linked(&record.address) {
            String::new()
        } else if report.is_some_and(|report| report.docker.is_none()) {
            "Without a list of its simulations, as the Python server: only its load is known".to_owned()
        } else if report.is_some_and(|report| report.reserves) {
            "Its simulations are listed on its own page only: its fleetKey is another one, or its /slots can't be \
             reached; the log of this session server says which"
                .to_owned()
        } else {
            "Its simulations are listed on its own page only: it has no fleetKey".to_owned()
        };
        ServerLine {
            page: format!("visit?server={}", percent_encoded(&record.address)),
            address: record.address.clone(),
            state: record.state.name(),
            note: one_line(&note),
            simulations: report
                .and_then(|report| report.instances)
                .map(|instances| instances.present()),
        }
    };
    status.servers.iter().map(line).collect()
}

/// A world that is kept ready, or will be, as the page shows it.
#[derive(Serialize)]
struct ReadyWorld<'status> {
    world: &'status ProjectUrl,
    mode: View,
    /// How many are to be ready now.
    wanted: u32,
    /// How many are.
    ready: u32,
    /// What `POST /ready` has asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    lesson: Option<&'status ReadyEntry>,
}

fn ready_worlds(status: &FleetStatus) -> Vec<ReadyWorld<'_>> {
    let mut worlds = Vec::new();
    for one in &status.ready {
        let mut lessons = status.requested.iter();
        worlds.push(ReadyWorld {
            world: &one.world,
            mode: one.mode,
            wanted: one.count,
            ready: status.ready(one),
            lesson: lessons.find(|entry| (&entry.world, entry.mode) == (&one.world, one.mode)),
        });
    }
    worlds
}

fn percent_encoded(address: &PublicAddress) -> String {
    url::form_urlencoded::byte_serialize(address.to_string().as_bytes()).collect()
}

/// What an event tells a page.
#[derive(Serialize)]
struct Event {
    version: &'static str,
    #[serde(flatten)]
    list: Option<List>,
    #[serde(skip_serializing_if = "Option::is_none")]
    servers: Option<Box<RawValue>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    ready: Option<Box<RawValue>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    announcement: Option<String>,
}

/// What has changed in the list.
#[derive(Serialize)]
struct List {
    all: bool,
    changed: Vec<ClassEntry>,
    gone: Vec<Key>,
}

/// The connection of a page.
struct Feed {
    server: web::Data<AppState>,
    /// The version of the list that the page knows.
    known: Option<u64>,
    /// The servers, and the worlds that are kept ready, that the page knows.
    servers: String,
    ready: String,
    announcement: Option<String>,
    /// Number of looks so far.
    looks: u32,
    /// The rest of an event.
    unsent: Bytes,
    /// Compresses all events as one text, if the browser can read that.
    encoder: Option<GzEncoder<Vec<u8>>>,
    _watching: Watching,
    _permit: ConnectionPermit,
}

async fn events(request: HttpRequest, server: web::Data<AppState>) -> Result<HttpResponse> {
    let permit = server
        .connections
        .admit(ConnectionKind::Page, server.config.trusted_proxies.peer(&request))?;
    server.admin_auth.reader(&request)?;
    let known = request
        .headers()
        .get("last-event-id")
        .and_then(|value| value.to_str().ok());
    let is_compressed = accepts_gzip(&request);
    let mut feed = Feed {
        known: known.and_then(|id| id.strip_prefix(&format!("{}-", server.run))?.parse().ok()),
        servers: String::new(),
        ready: String::new(),
        announcement: None,
        looks: 0,
        unsent: Bytes::new(),
        encoder: is_compressed.then(|| GzEncoder::new(Vec::new(), Compression::default())),
        _watching: server.roster.watch(),
        _permit: permit,
        server: server.clone(),
    };
    feed.unsent = feed.encoded(b"retry: 2000\n\n");
    let mut response = HttpResponse::Ok();
    if is_compressed {
        response.insert_header((header::CONTENT_ENCODING, "gzip"));
    }
    Ok(response
        .content_type("text/event-stream")
        .insert_header((header::CACHE_CONTROL, "no-store"))
        // A reverse proxy must not buffer events.
        .insert_header(("X-Accel-Buffering", "no"))
        .streaming(stream::unfold(feed, Feed::next).take_until(Box::pin(closing(server.phase.clone())))))
}

impl Feed {
    /// Returns the next bytes for the page.
    async fn next(mut self) -> Option<(std::result::Result<Bytes, Infallible>, Self)> {
        if self.unsent.is_empty() {
            let event = self.next_event().await;
            self.unsent = self.encoded(event.as_bytes());
        }
        let chunk = self.unsent.split_to(CHUNK.min(self.unsent.len()));
        Some((Ok(chunk), self))
    }

    fn encoded(&mut self, event: &[u8]) -> Bytes {
        let Some(encoder) = &mut self.encoder else {
            return Bytes::copy_from_slice(event);
        };
        // Writing to memory never fails.
        encoder.write_all(event).and_then(|()| encoder.flush()).ok();
        std::mem::take(encoder.get_mut()).into()
    }

    async fn next_event(&mut self) -> String {
        for _ in 0..KEEP_ALIVE {
            if self.looks > 0 {
                sleep(PERIOD).await;
            }
            let event = self.look().await;
            self.looks = self.looks.wrapping_add(1);
            if let Some(event) = event {
                let text = serde_json::to_string(&event).unwrap_or_default();
                let version = self.known.unwrap_or_default();
                return format!("id: {}-{version}\ndata: {text}\n\n", self.server.run);
            }
        }
        "data: {}\n\n".to_owned()
    }

    /// What the page does not know yet.
    async fn look(&mut self) -> Option<Event> {
        self.server.look_at_line().await;
        let is_new = self.known != Some(self.server.roster.version());
        let list = is_new.then(|| self.server.roster.since(self.known));
        let list = list.map(
            |Changes {
                 version,
                 all,
                 changed,
                 gone,
             }| {
                self.known = Some(version);
                List { all, changed, gone }
            },
        );
        let (mut servers, mut ready) = (None, None);
        if self.looks.is_multiple_of(SERVERS)
            && let Ok(status) = self.server.status().await
        {
            servers = if_new(&mut self.servers, &server_lines(&self.server, &status));
            ready = if_new(&mut self.ready, &ready_worlds(&status));
        }
        let announcement = self.server.announcement.borrow().clone();
        let announcement = (self.announcement.as_ref() != Some(&announcement)).then_some(announcement);
        self.announcement = announcement.clone().or(self.announcement.take());
        let has_news = list.is_some() || servers.is_some() || ready.is_some() || announcement.is_some();
        has_news.then_some(Event {
            version: env!("CARGO_PKG_VERSION"),
            list,
            servers,
            ready,
            announcement,
        })
    }
}

/// These lines, if they are not as the page knows them.
fn if_new(known: &mut String, lines: &impl Serialize) -> Option<Box<RawValue>> {
    let lines = serde_json::to_string(lines).ok()?;
    if lines == *known {
        return None;
    }
    known.clone_from(&lines);
    RawValue::from_string(lines).ok()
}
