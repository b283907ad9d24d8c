//! Pages that stay true without reloading: server-sent events, made once per second for all who listen.
//!
//! One task per server renders what its page shows, only while somebody listens, and sends what has changed since the
//! second before. A page that has just come, or was too slow for some events, is sent everything.

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

use crate::shared::run::{Phase, closing};

/// Between two renderings.
const PERIOD: Duration = Duration::from_secs(1);
/// An event costs a pause of one more period for each so many bytes of it: a hundred pages of a large fleet must not
/// keep its server busy.
const LARGE: usize = 32 * 1024;
/// The longest pause, in periods.
const LONGEST: usize = 5;
/// After so many renderings without a change a sign of life is sent.
const QUIET: u32 = 15;
/// How many pages may listen.
const MOST_PAGES: usize = 1000;
/// How many events a page may be behind before it is sent everything anew.
const BEHIND: usize = 8;

/// What a page shows: the parts of it that change. Each text is HTML.
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
    /// What tells it from the others.
    pub key: String,
    /// Its cells, each beginning on a line of its own.
    pub html: String,
}

/// An event as the page's script reads it.
#[derive(Serialize)]
struct Event<'view> {
    /// Of the server: a page of another version loads itself again.
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
    /// The keys of all rows in their order, where that has changed.
    #[serde(skip_serializing_if = "Option::is_none")]
    order: Option<Vec<&'view str>>,
    /// The cells that have changed, by the keys of their rows and their columns.
    rows: BTreeMap<&'view str, BTreeMap<usize, &'view str>>,
}

/// The pages of a server that listen.
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
    quiet: u32,
}

impl Live {
    /// Nobody listens yet.
    #[must_use]
    pub fn new() -> Self {
        Self { state: Arc::default(), events: broadcast::Sender::new(BEHIND) }
    }

    /// Answers a page that wants to listen; `render` is what the task does each second.
    pub fn listen<R, F>(&self, phase: watch::Receiver<Phase>, render: R) -> HttpResponse
    where
        R: Fn() -> F + 'static,
        F: Future<Output = Option<View>> + 'static,
    {
        if self.events.receiver_count() >= MOST_PAGES {
            return HttpResponse::ServiceUnavailable().body("Error: too many pages are open.");
        }
        let mut state = self.lock();
        let listener = Listener {
            live: self.clone(),
            events: self.events.subscribe(),
            first: Some(state.view.as_ref().map_or_else(|| Bytes::from_static(b"retry: 2000\n\n"), everything)),
            closing: Box::pin(closing(phase)),
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
            // A web server in front would keep events until there are many.
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

    /// Sends what has changed; gives back how many periods to wait until the next time.
    fn publish(&self, view: View) -> u32 {
        let mut state = self.lock();
        let event = difference(state.view.as_ref(), &view);
        // The first one is the whole page, and nobody waits for the second because of it.
        let size = event.as_ref().filter(|_| state.view.is_some()).map_or(0, Bytes::len);
        state.quiet = if event.is_some() { 0 } else { state.quiet + 1 };
        let quiet = state.quiet.is_multiple_of(QUIET).then(|| Bytes::from_static(b"data: {}\n\n"));
        state.view = Some(view);
        if let Some(event) = event.or(quiet) {
            // Nobody may be there to hear it.
            self.events.send(event).ok();
        }
        u32::try_from((1 + size / LARGE).min(LONGEST)).unwrap_or(1)
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

/// The task that renders. When it ends, be it by a panic, the pages that still listen are sent away: they come back,
/// and the next one starts another.
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
    first: Option<Bytes>,
    closing: LocalBoxFuture<'static, ()>,
}

impl Listener {
    async fn next(mut self) -> Option<(Result<Bytes, std::convert::Infallible>, Self)> {
        if let Some(first) = self.first.take() {
            return Some((Ok(first), self));
        }
        let event = tokio::select! {
            event = self.events.recv() => event,
            () = &mut self.closing => return None,
        };
        match event {
            Ok(end) if end.is_empty() => None,
            Ok(event) => Some((Ok(event), self)),
            Err(broadcast::error::RecvError::Closed) => None,
            Err(broadcast::error::RecvError::Lagged(_)) => {
                let state = self.live.lock();
                self.events = self.events.resubscribe();
                let all = state.view.as_ref().map_or_else(Bytes::new, everything);
                drop(state);
                Some((Ok(all), self))
            }
        }
    }
}

fn everything(view: &View) -> Bytes {
    difference(None, view).unwrap_or_default()
}

/// The event that turns one view into another; nothing where they are the same.
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
            (old != Some(row.html.as_str())).then(|| (row.key.as_str(), changed_cells(old, &row.html)))
        });
        Self { order: (!same_order).then(|| keys(after)), rows: changed.collect() }
    }
}

/// The cells of a row that differ from those before, all where there were none.
fn changed_cells<'view>(before: Option<&str>, after: &'view str) -> BTreeMap<usize, &'view str> {
    let mut old = before.map(cells).into_iter().flatten();
    cells(after).enumerate().filter(|(_, cell)| old.next() != Some(*cell)).collect()
}

/// The cells of a row. What stands in them is escaped: only a cell of its own can begin like one.
fn cells(html: &str) -> impl Iterator<Item = &str> {
    let mut rest = Some(html);
    std::iter::from_fn(move || {
        let html = rest?;
        let (cell, more) =
            html.find("\n<t").map_or((html, None), |end| (html.get(..end).unwrap_or_default(), html.get(end + 1..)));
        rest = more;
        Some(cell)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(glance: &str, rows: &[(&str, &str)]) -> View {
        let rows = rows.iter().map(|(key, html)| Row { key: (*key).to_owned(), html: (*html).to_owned() }).collect();
        View {
            parts: [("glance", glance.to_owned()), ("more", "same".to_owned())].into(),
            tables: [("servers", rows)].into(),
            sample: Vec::new(),
        }
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
            "data: {\"tables\":{\"servers\":{\"rows\":{\"b\":{\"0\":\"3\"}}}}}\n\n"
        );
        assert_eq!(
            event(&before, &view("one", &[("b", "2")])),
            "data: {\"tables\":{\"servers\":{\"order\":[\"b\"],\"rows\":{}}}}\n\n"
        );
    }

    #[test]
    fn of_a_row_only_the_cells_that_have_changed_are_sent() {
        let columns = |load: &str| format!("<th>a</th>\n<td>{load}</td>\n<td>two\nlines</td>");
        let before = view("one", &[("a", &columns("1"))]);
        assert_eq!(
            event(&before, &view("one", &[("a", &columns("2"))])),
            "data: {\"tables\":{\"servers\":{\"rows\":{\"a\":{\"1\":\"<td>2</td>\"}}}}}\n\n"
        );
        let all: Vec<String> = cells(&columns("3")).map(str::to_owned).collect();
        assert_eq!(all, ["<th>a</th>", "<td>3</td>", "<td>two\nlines</td>"]);
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
        let response = live.listen(phase, || async { Some(View::default()) });
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
        let page = live.listen(phase.clone(), || async { panic!("this panic is part of a test") });
        let end = actix_web::body::to_bytes(page.into_body());
        assert!(actix_rt::time::timeout(Duration::from_secs(10), end).await.is_ok(), "it waits for ever");
        assert!(!live.lock().running);
        let _again = live.listen(phase, || async { Some(View::default()) });
        assert!(live.lock().running);
    }
}
