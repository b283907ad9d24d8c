//! Live pages: server-sent events with what has changed on a page.
//!
//! While pages listen, one task per server renders the page once per second, and sends what has changed to all of them. A
//! page that has just connected, or was too slow for some events, is sent the whole view.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use actix_web::HttpResponse;
use actix_web::http::header;
use actix_web::web::Bytes;
use futures_util::future::LocalBoxFuture;
use futures_util::stream;
use serde::Serialize;
use tokio::sync::{broadcast, watch};

use super::connections::ConnectionPermit;
use crate::shared::run::{Phase, closing};

/// The time between two renderings.
const PERIOD: Duration = Duration::from_secs(1);
/// After an event, the next rendering waits one more period for each so many bytes, so that a hundred pages of a large fleet do
/// not keep the server busy.
const LARGE: usize = 32 * 1024;
/// The longest time between two renderings, in periods.
const MAX_PERIODS: usize = 5;
/// After how many renderings without a change an empty event is sent, so that pages know that the server is there.
const KEEP_ALIVE: u32 = 15;
/// How many events a page may miss before it is sent the whole view.
const MAX_LAG: usize = 8;
/// How many bytes are handed to a connection at once. All connections share the bytes of an event; only what is handed to
/// one is copied, so that a page which does not read costs little memory.
const CHUNK: usize = 8 * 1024;

/// The parts of a page that change. Each text is HTML.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct View {
    /// The contents of elements, by their `id`.
    pub parts: BTreeMap<&'static str, String>,
    /// The rows of table bodies, by the body's `id`.
    pub tables: BTreeMap<&'static str, Vec<Row>>,
    /// Numbers for the page's charts.
    pub sample: Vec<String>,
}

/// A row of a table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Row {
    /// Identifies the row among those of its table.
    pub key: String,
    /// Its cells.
    pub html: String,
}

/// An event as the page's script reads it.
#[derive(Serialize)]
struct Event<'view> {
    /// The server's version: a page of another version reloads itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    version: Option<&'static str>,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    parts: BTreeMap<&'static str, &'view str>,
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    tables: BTreeMap<&'static str, Table<'view>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    sample: Option<&'view [String]>,
}

#[derive(Serialize)]
struct Table<'view> {
    /// The keys of all rows in their order, if that has changed.
    #[serde(skip_serializing_if = "Option::is_none")]
    order: Option<Vec<&'view str>>,
    /// The rows that have changed, by their keys.
    rows: BTreeMap<&'view str, &'view str>,
}

/// The live pages of a server.
#[derive(Clone)]
pub struct Live {
    state: Arc<Mutex<State>>,
    events: broadcast::Sender<Bytes>,
}

#[derive(Default)]
struct State {
    /// Whether the task runs.
    running: bool,
    /// What was rendered last.
    view: Option<View>,
    /// The event that holds all of `view`, made when the first page needs it.
    whole: Option<Bytes>,
    /// How many renderings have changed nothing.
    unchanged: u32,
}

impl State {
    /// The event that holds all of the view.
    fn whole(&mut self) -> Option<Bytes> {
        if self.whole.is_none() {
            self.whole = difference(None, self.view.as_ref()?);
        }
        self.whole.clone()
    }
}

impl Live {
    /// Creates live pages to which nobody listens yet.
    #[must_use]
    pub fn new() -> Self {
        Self { state: Arc::default(), events: broadcast::Sender::new(MAX_LAG) }
    }

    /// Answers a page that wants to listen. `permit` counts it; `render` is called once per second.
    pub fn listen<R, F>(&self, permit: ConnectionPermit, phase: watch::Receiver<Phase>, render: R) -> HttpResponse
    where
        R: Fn() -> F + 'static,
        F: Future<Output = Option<View>> + 'static,
    {
        let mut state = self.lock();
        let listener = Listener {
            live: self.clone(),
            events: self.events.subscribe(),
            unsent: state.whole().unwrap_or(Bytes::from_static(b"retry: 2000\n\n")),
            closing: Box::pin(closing(phase)),
            _permit: permit,
        };
        if !std::mem::replace(&mut state.running, true) {
            let live = self.clone();
            actix_rt::spawn(async move {
                let _task = Task(live.clone());
                live.render_each_period(render).await;
            });
        }
        drop(state);
        HttpResponse::Ok()
            .content_type("text/event-stream")
            .insert_header((header::CACHE_CONTROL, "no-store"))
            // A web server in front must not collect events.
            .insert_header(("X-Accel-Buffering", "no"))
            .streaming(stream::unfold(listener, Listener::next))
    }

    async fn render_each_period<R, F>(&self, render: R)
    where
        R: Fn() -> F,
        F: Future<Output = Option<View>>,
    {
        loop {
            let periods = render().await.map_or(1, |view| self.publish(view));
            actix_rt::time::sleep(PERIOD * periods).await;
            if self.events.receiver_count() == 0 {
                return;
            }
        }
    }

    /// Sends what has changed. Returns how many periods to wait until the next rendering.
    fn publish(&self, view: View) -> u32 {
        let mut state = self.lock();
        let is_first = state.view.is_none();
        let Some(event) = difference(state.view.as_ref(), &view) else {
            state.unchanged += 1;
            if state.unchanged.is_multiple_of(KEEP_ALIVE) {
                self.events.send(Bytes::from_static(b"data: {}\n\n")).ok();
            }
            return 1;
        };
        // The first event is the whole page: the second need not wait because of it.
        let size = if is_first { 0 } else { event.len() };
        (state.view, state.whole, state.unchanged) = (Some(view), None, 0);
        // It fails if no page listens any more.
        self.events.send(event).ok();
        u32::try_from((1 + size / LARGE).min(MAX_PERIODS)).unwrap_or(1)
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Default for Live {
    fn default() -> Self {
        Self::new()
    }
}

/// The task that renders. When it ends, also by a panic, the pages that still listen are disconnected: they connect again,
/// and the first of them starts another task.
struct Task(Live);

impl Drop for Task {
    fn drop(&mut self) {
        let mut state = self.0.lock();
        *state = State::default();
        self.0.events.send(Bytes::new()).ok();
    }
}

struct Listener {
    live: Live,
    events: broadcast::Receiver<Bytes>,
    /// The rest of an event.
    unsent: Bytes,
    closing: LocalBoxFuture<'static, ()>,
    _permit: ConnectionPermit,
}

impl Listener {
    async fn next(mut self) -> Option<(Result<Bytes, std::convert::Infallible>, Self)> {
        if !self.unsent.is_empty() {
            return Some((Ok(self.chunk()), self));
        }
        let event = tokio::select! {
            event = self.events.recv() => event,
            () = &mut self.closing => return None,
        };
        match event {
            Ok(end) if end.is_empty() => None,
            Ok(event) => {
                self.unsent = event;
                Some((Ok(self.chunk()), self))
            }
            Err(broadcast::error::RecvError::Closed) => None,
            Err(broadcast::error::RecvError::Lagged(_)) => {
                let mut state = self.live.lock();
                let events = self.events.resubscribe();
                self.unsent = state.whole().unwrap_or_default();
                drop(state);
                self.events = events;
                Some((Ok(self.chunk()), self))
            }
        }
    }
}

impl Listener {
    /// Takes the next bytes out of the unsent ones.
    fn chunk(&mut self) -> Bytes {
        self.unsent.split_to(CHUNK.min(self.unsent.len()))
    }
}

/// The event that turns one view into another; nothing if they are the same.
fn difference(before: Option<&View>, after: &View) -> Option<Bytes> {
    if before == Some(after) {
        return None;
    }
    let old_part = |id| before.and_then(|view| view.parts.get(id));
    let parts = after.parts.iter().filter(|(id, html)| old_part(*id) != Some(*html));
    let tables = after.tables.iter().filter_map(|(id, rows)| {
        let old = before.and_then(|view| view.tables.get(id));
        (old != Some(rows)).then(|| (*id, Table::new(old, rows)))
    });
    let event = Event {
        version: before.is_none().then_some(env!("CARGO_PKG_VERSION")),
        parts: parts.map(|(id, html)| (*id, html.as_str())).collect(),
        tables: tables.collect(),
        sample: (before.map(|view| &view.sample) != Some(&after.sample)).then_some(&after.sample),
    };
    let json = serde_json::to_string(&event).unwrap_or_default();
    Some(Bytes::from(format!("data: {json}\n\n")))
}

impl<'view> Table<'view> {
    fn new(before: Option<&Vec<Row>>, after: &'view [Row]) -> Self {
        let keys = |rows: &'view [Row]| rows.iter().map(|row| row.key.as_str()).collect::<Vec<_>>();
        let known: BTreeMap<&str, &str> =
            before.into_iter().flatten().map(|row| (row.key.as_str(), row.html.as_str())).collect();
        let same_order =
            before.is_some_and(|before| before.iter().map(|row| &row.key).eq(after.iter().map(|row| &row.key)));
        let changed = after.iter().filter_map(|row| {
            let old = known.get(row.key.as_str()).copied();
            (old != Some(row.html.as_str())).then_some((row.key.as_str(), row.html.as_str()))
        });
        Self { order: (!same_order).then(|| keys(after)), rows: changed.collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::http::connections::{Connections, Kind};
    use crate::shared::http::peer::Peer;

    fn view(glance: &str, rows: &[(&str, &str)]) -> View {
        let rows = rows.iter().map(|(key, html)| Row { key: (*key).to_owned(), html: (*html).to_owned() }).collect();
        View {
            parts: [("glance", glance.to_owned()), ("more", "same".to_owned())].into(),
            tables: [("servers", rows)].into(),
            sample: Vec::new(),
        }
    }

    fn permit() -> ConnectionPermit {
        Connections::new(1, 1, Some(1)).admit(Kind::Page, Peer::Unknown).unwrap()
    }

    fn event(before: &View, after: &View) -> String {
        difference(Some(before), after).map(|bytes| String::from_utf8(bytes.to_vec()).unwrap()).unwrap_or_default()
    }

    #[test]
    fn only_what_has_changed_is_sent() {
        let before = view("one", &[("a", "1"), ("b", "2")]);
        assert_eq!(event(&before, &before.clone()), "");
        assert_eq!(
            event(&before, &view("two", &[("a", "1"), ("b", "2")])),
            "data: {\"parts\":{\"glance\":\"two\"}}\n\n"
        );
        assert_eq!(
            event(&before, &view("one", &[("a", "1"), ("b", "3")])),
            "data: {\"tables\":{\"servers\":{\"rows\":{\"b\":\"3\"}}}}\n\n"
        );
        assert_eq!(
            event(&before, &view("one", &[("b", "2")])),
            "data: {\"tables\":{\"servers\":{\"order\":[\"b\"],\"rows\":{}}}}\n\n"
        );
    }

    #[test]
    fn after_a_large_event_the_pause_is_longer() {
        let live = Live::new();
        let large = |letter: &str| view(&letter.repeat(LARGE), &[]);
        for (view, pause) in [(large("a"), 1), (large("a"), 1), (large("b"), 2), (view("small", &[]), 1)] {
            assert_eq!(live.publish(view), pause);
        }
        assert_eq!(live.publish(view(&"c".repeat(100 * LARGE), &[])), 5);
    }

    #[actix_rt::test]
    async fn the_task_runs_only_while_somebody_listens() {
        let live = Live::new();
        let (_sender, phase) = watch::channel(Phase::Open);
        let response = live.listen(permit(), phase, || async { Some(View::default()) });
        assert!(live.lock().running);
        drop(response);
        let deadline = std::time::Instant::now() + Duration::from_secs(10);
        while live.lock().running {
            assert!(std::time::Instant::now() < deadline, "it runs for nobody");
            actix_rt::time::sleep(Duration::from_millis(20)).await;
        }
    }

    #[actix_rt::test]
    async fn a_page_whose_task_has_failed_is_sent_away_and_may_come_back() {
        let live = Live::new();
        let (_sender, phase) = watch::channel(Phase::Open);
        let page = live.listen(permit(), phase.clone(), || async { panic!("this panic is part of a test") });
        let end = actix_web::body::to_bytes(page.into_body());
        assert!(actix_rt::time::timeout(Duration::from_secs(10), end).await.is_ok(), "it waits for ever");
        assert!(!live.lock().running);
        let _again = live.listen(permit(), phase, || async { Some(View::default()) });
        assert!(live.lock().running);
    }
}
