//! Live pages: server-sent events with the parts of a page that change.
//!
//! While pages listen, one of them renders these parts for all once per second. Each page receives the latest version if
//! it has changed; a slow one skips versions.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix_rt::time::sleep;
use actix_web::HttpResponse;
use actix_web::http::header;
use actix_web::web::Bytes;
use futures_util::stream::{self, StreamExt};
use serde::Serialize;
use tokio::sync::{Mutex, watch};

use super::limits::ConnectionPermit;
use crate::shared::run::{Phase, leaving};

/// Interval between two renderings.
const PERIOD: Duration = Duration::from_secs(1);
/// The next rendering waits one more period per this many bytes of the event, so that a hundred pages of a large fleet do
/// not keep the server busy.
const LARGE: usize = 32 * 1024;
/// Longest interval between two renderings, in periods.
const MAX_PERIODS: usize = 5;
/// Interval of empty events while nothing changes, in periods: they show a page that the server is alive.
const KEEP_ALIVE: u32 = 15;
/// Bytes that are written to a connection at once. All connections share the bytes of an event; only a chunk is copied,
/// so that a page that does not read costs little memory.
const CHUNK: usize = 8 * 1024;

/// The parts of a page that change. Each text is HTML.
#[derive(Debug, Clone, Default, Serialize)]
pub struct PageView {
    /// The contents of elements, by their `id`.
    pub parts: BTreeMap<&'static str, String>,
    /// The rows of table bodies, by the body's `id`.
    pub tables: BTreeMap<&'static str, Vec<TableRow>>,
    /// Numbers for the page's charts.
    pub sample: Vec<f64>,
}

/// A row of a table.
#[derive(Debug, Clone, Serialize)]
pub struct TableRow {
    /// Key of the row, unique in its table.
    pub key: String,
    /// The HTML of its cells.
    pub html: String,
}

/// An event as the page's script reads it.
#[derive(Serialize)]
struct Event<'view> {
    /// The server's version; a page of another version reloads itself.
    version: &'static str,
    #[serde(flatten)]
    view: &'view PageView,
}

/// The live pages of a server. Clones share the latest event.
#[derive(Clone, Default)]
pub struct LiveUpdates(Arc<Mutex<Latest>>);

/// The latest event.
#[derive(Default)]
struct Latest {
    event: Bytes,
    /// When it was rendered; `None` before the first.
    at: Option<Instant>,
}

impl LiveUpdates {
    /// Answers a page that listens. `permit` counts it; `render` is called at most once per second.
    pub fn listen<R, F>(&self, permit: ConnectionPermit, phase: watch::Receiver<Phase>, render: R) -> HttpResponse
    where
        R: Fn() -> F + 'static,
        F: Future<Output = Option<PageView>> + 'static,
    {
        let unsent = Bytes::from_static(b"retry: 2000\n\n");
        let page = EventStream {
            live: self.clone(),
            render,
            unsent,
            last: Bytes::new(),
            _permit: permit,
        };
        HttpResponse::Ok()
            .content_type("text/event-stream")
            .insert_header((header::CACHE_CONTROL, "no-store"))
            // A reverse proxy must not buffer events.
            .insert_header(("X-Accel-Buffering", "no"))
            .streaming(stream::unfold(page, EventStream::next).take_until(Box::pin(leaving(phase))))
    }

    /// Returns the latest event, after rendering it again if it is old.
    async fn latest<F: Future<Output = Option<PageView>>>(&self, render: impl Fn() -> F) -> Bytes {
        let mut latest = self.0.lock().await;
        let periods = u32::try_from((1 + latest.event.len() / LARGE).min(MAX_PERIODS)).unwrap_or(1);
        if latest.at.is_none_or(|at| at.elapsed() >= PERIOD * periods) {
            if let Some(view) = render().await {
                let event = Event {
                    version: env!("CARGO_PKG_VERSION"),
                    view: &view,
                };
                let event = format!("data: {}\n\n", serde_json::to_string(&event).unwrap_or_default());
                // An unchanged event keeps its allocation, because pages compare its address.
                if latest.event != event.as_bytes() {
                    latest.event = event.into();
                }
            }
            latest.at = Some(Instant::now());
        }
        latest.event.clone()
    }
}

/// The connection of a page.
struct EventStream<R> {
    live: LiveUpdates,
    render: R,
    /// The rest of an event.
    unsent: Bytes,
    /// The event that was sent last.
    last: Bytes,
    _permit: ConnectionPermit,
}

impl<R: Fn() -> F, F: Future<Output = Option<PageView>>> EventStream<R> {
    /// Returns the next bytes for the page.
    async fn next(mut self) -> Option<(Result<Bytes, Infallible>, Self)> {
        if self.unsent.is_empty() {
            self.unsent = self.next_event().await;
        }
        let chunk = self.unsent.split_to(CHUNK.min(self.unsent.len()));
        Some((Ok(chunk), self))
    }

    async fn next_event(&mut self) -> Bytes {
        for _ in 0..KEEP_ALIVE {
            let event = self.live.latest(&self.render).await;
            if event.as_ptr() != self.last.as_ptr() {
                self.last = event.clone();
                return event;
            }
            sleep(PERIOD).await;
        }
        Bytes::from_static(b"data: {}\n\n")
    }
}
