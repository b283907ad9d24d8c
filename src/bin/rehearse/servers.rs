//! Monitors the load of the simulation servers that clients are sent to.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::time::Duration;

use crate::http::{client, get};

/// The simulation servers of the clients, by their WebSocket URL, and the highest load of each, in percent.
#[derive(Default)]
pub(crate) struct Servers(RefCell<BTreeMap<String, Option<f64>>>);

/// Interval between two requests to each server.
const PERIOD: Duration = Duration::from_secs(1);

impl Servers {
    /// Adds a server that a client was sent to.
    pub(crate) fn met(&self, url: &str) {
        self.0.borrow_mut().entry(url.to_owned()).or_default();
    }

    /// Requests the load of each server periodically, until dropped.
    pub(crate) async fn watch(&self) {
        let http = client();
        loop {
            let known: Vec<String> = self.0.borrow().keys().cloned().collect();
            let asked = known.iter().map(|server| self.ask(&http, server));
            futures_util::future::join_all(asked).await;
            actix_rt::time::sleep(PERIOD).await;
        }
    }

    async fn ask(&self, http: &awc::Client, server: &str) {
        let answer = get(http, &format!("{}/load", server.replacen("ws", "http", 1))).await;
        // A server that is too busy to answer keeps its last load.
        let load = answer
            .ok()
            .and_then(|answer| answer.text.trim().parse::<f64>().ok())
            .filter(|load| load.is_finite());
        if let (Some(load), Some(peak)) = (load, self.0.borrow_mut().get_mut(server)) {
            *peak = Some(peak.map_or(load, |peak| peak.max(load)));
        }
    }

    /// The highest load of each server, by its address, in percent; `None` if it never reported one.
    pub(crate) fn peaks(&self) -> BTreeMap<String, Option<f64>> {
        let known = self.0.borrow();
        known
            .iter()
            .filter_map(|(url, peak)| Some((url.split_once("://")?.1.to_owned(), *peak)))
            .collect()
    }
}
