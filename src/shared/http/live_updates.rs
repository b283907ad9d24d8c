//! Live pages: server-sent events with the parts of a page that change.
//!
//! While pages listen, one task per server renders these parts once per second, and publishes them if they have
//! changed. Each page receives the latest version; a slow one skips versions.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use actix_web::HttpResponse;
use actix_web::http::header;
use actix_web::web::Bytes;
use futures_util::stream::{self, StreamExt};
use parking_lot::Mutex;
use serde::Serialize;
use tokio::sync::watch;

use super::connections::ConnectionPermit;
use crate::shared::run::{Phase, closing};

/// Interval between two renderings.
const PERIOD: Duration = Duration::from_secs(1);
/// After an event, the next rendering waits one more period per this many bytes, so that a hundred pages of a large
/// fleet do not keep the server busy.
const LARGE: usize = 32 * 1024;
/// Longest interval between two renderings, in periods.
const MAX_PERIODS: usize = 5;
/// Interval of empty events while nothing changes, which show a page that the server is alive.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
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
    pub sample: Vec<String>,
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

/// The live pages of a server.
#[derive(Clone, Default)]
pub struct LiveUpdates {
    /// The events of the rendering task; `None` if no page listens.
    events: Arc<Mutex<Option<watch::Receiver<Bytes>>>>,
}

impl LiveUpdates {
    /// Answers a page that listens. `permit` counts it; `render` is called once per second.
    pub fn listen<R, F>(&self, permit: ConnectionPermit, phase: watch::Receiver<Phase>, render: R) -> HttpResponse
    where
        R: Fn() -> F + 'static,
        F: Future<Output = Option<PageView>> + 'static,
    {
        let mut running = self.events.lock();
        // A task that has panicked has dropped its sender.
        let events = running.clone().filter(|events| events.has_changed().is_ok());
        let mut events = events.unwrap_or_else(|| {
            let (sender, events) = watch::channel(Bytes::from_static(b"retry: 2000\n\n"));
            *running = Some(events.clone());
            actix_rt::spawn(self.clone().render_each_period(sender, render));
            events
        });
        drop(running);
        events.mark_changed();
        let page = EventStream { events, unsent: Bytes::new(), _permit: permit };
        HttpResponse::Ok()
            .content_type("text/event-stream")
            .insert_header((header::CACHE_CONTROL, "no-store"))
            // A reverse proxy must not buffer events.
            .insert_header(("X-Accel-Buffering", "no"))
            .streaming(stream::unfold(page, EventStream::next).take_until(Box::pin(closing(phase))))
    }

    async fn render_each_period<R, F>(self, events: watch::Sender<Bytes>, render: R)
    where
        R: Fn() -> F,
        F: Future<Output = Option<PageView>>,
    {
        loop {
            let periods = render().await.map_or(1, |view| publish(&events, &view));
            actix_rt::time::sleep(PERIOD * periods).await;
            let mut running = self.events.lock();
            // The last receiver is the one in `self.events`.
            if events.receiver_count() == 1 {
                *running = None;
                return;
            }
        }
    }
}

/// Publishes a view if it has changed. Returns the number of periods until the next rendering.
fn publish(events: &watch::Sender<Bytes>, view: &PageView) -> u32 {
    let json = serde_json::to_string(&Event { version: env!("CARGO_PKG_VERSION"), view }).unwrap_or_default();
    let event = Bytes::from(format!("data: {json}\n\n"));
    let size = event.len();
    let has_changed = events.send_if_modified(|last| {
        let has_changed = *last != event;
        *last = event;
        has_changed
    });
    if has_changed { u32::try_from((1 + size / LARGE).min(MAX_PERIODS)).unwrap_or(1) } else { 1 }
}

/// The connection of a page.
struct EventStream {
    events: watch::Receiver<Bytes>,
    /// The rest of an event.
    unsent: Bytes,
    _permit: ConnectionPermit,
}

impl EventStream {
    /// Returns the next bytes for the page; `None` if the rendering task has panicked.
    async fn next(mut self) -> Option<(Result<Bytes, std::convert::Infallible>, Self)> {
        if self.unsent.is_empty() {
            self.unsent = match actix_rt::time::timeout(KEEP_ALIVE, self.events.changed()).await {
                Ok(Ok(())) => self.events.borrow_and_update().clone(),
                Ok(Err(_)) => return None,
                Err(_) => Bytes::from_static(b"data: {}\n\n"),
            };
        }
        let chunk = self.unsent.split_to(CHUNK.min(self.unsent.len()));
        Some((Ok(chunk), self))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::http::connections::{ConnectionKind, ConnectionLimiter};
    use crate::shared::http::peer::Peer;

    fn view(glance: &str) -> PageView {
        PageView { parts: [("glance", glance.to_owned())].into(), ..PageView::default() }
    }

    fn permit() -> ConnectionPermit {
        ConnectionLimiter::new(1, 1, Some(1)).admit(ConnectionKind::Page, Peer::Unknown).unwrap()
    }

    #[test]
    fn after_a_large_event_the_pause_is_longer() {
        let (events, pages) = watch::channel(Bytes::new());
        let large = |letter: &str| view(&letter.repeat(LARGE));
        for (view, pause) in [(large("a"), 2), (large("a"), 1), (large("b"), 2), (view("small"), 1)] {
            assert_eq!(publish(&events, &view), pause);
        }
        assert_eq!(publish(&events, &view(&"c".repeat(100 * LARGE))), 5);
        drop(pages);
    }

    #[actix_rt::test]
    async fn the_task_runs_only_while_somebody_listens() {
        let live = LiveUpdates::default();
        let (_sender, phase) = watch::channel(Phase::Open);
        let response = live.listen(permit(), phase, || async { Some(PageView::default()) });
        assert!(live.events.lock().is_some());
        drop(response);
        let deadline = std::time::Instant::now() + Duration::from_secs(10);
        while live.events.lock().is_some() {
            assert!(std::time::Instant::now() < deadline, "it runs for nobody");
            actix_rt::time::sleep(Duration::from_millis(20)).await;
        }
    }

    #[actix_rt::test]
    async fn a_page_whose_task_has_failed_is_sent_away_and_may_come_back() {
        let live = LiveUpdates::default();
        let (_sender, phase) = watch::channel(Phase::Open);
        let page = live.listen(permit(), phase.clone(), || async { panic!("this panic is part of a test") });
        let end = actix_web::body::to_bytes(page.into_body());
        assert!(actix_rt::time::timeout(Duration::from_secs(10), end).await.is_ok(), "it waits for ever");
        let again = live.listen(permit(), phase, || async { Some(view("well")) });
        let mut body = Box::pin(again.into_body());
        let heard = std::future::poll_fn(|context| actix_web::body::MessageBody::poll_next(body.as_mut(), context));
        assert!(actix_rt::time::timeout(Duration::from_secs(10), heard).await.unwrap().is_some());
    }
}
