//! A web server that records what is posted to it, and answers as a test demands.

use std::net::TcpListener;
use std::sync::Arc;

use parking_lot::Mutex;
use serde_json::Value;

use super::authority::Certificate;
use super::listener::serve;
use super::until;

/// A request: its first line and its body.
#[derive(Debug, Clone)]
pub struct Posted {
    pub line: String,
    pub body: Value,
}

/// The web server, as long as the test runs.
pub struct Receiver {
    pub port: u16,
    posted: Arc<Mutex<Vec<Posted>>>,
    answer: Arc<Mutex<String>>,
}

impl Receiver {
    /// Starts a server over HTTP, or over TLS if there is a certificate.
    pub fn start(certificate: Option<&Certificate>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let receiver = Self {
            port,
            posted: Arc::default(),
            answer: Arc::new(Mutex::new("200 OK".to_owned())),
        };
        let posted = Arc::clone(&receiver.posted);
        let answer = Arc::clone(&receiver.answer);
        serve(listener, certificate.map(Certificate::server), move |request| {
            assert_eq!(request.header("content-type"), "application/json");
            let line = request.head.lines().next().unwrap().to_owned();
            posted.lock().push(Posted {
                line,
                body: serde_json::from_slice(&request.content).unwrap(),
            });
            Some((answer.lock().clone(), Vec::new()))
        });
        receiver
    }

    /// Sets the answer from now on: the status, and headers after a line break.
    pub fn answer(&self, answer: &str) {
        *self.answer.lock() = answer.to_owned();
    }

    /// All requests so far.
    pub fn posted(&self) -> Vec<Posted> {
        self.posted.lock().clone()
    }

    /// The texts of the requests, once at least this many have arrived.
    pub async fn texts(&self, count: usize) -> Vec<String> {
        until(&format!("{count} were posted"), async || self.posted().len() >= count).await;
        let text = |posted: &Posted| posted.body["text"].as_str().unwrap().to_owned();
        self.posted().iter().map(text).collect()
    }
}
