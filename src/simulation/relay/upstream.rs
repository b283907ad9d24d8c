//! How this server reaches simulations, and the files that they serve.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use actix_rt::time::timeout;
use actix_web::http::StatusCode;
use actix_web::http::header::{self, HeaderName};
use actix_web::{HttpRequest, HttpResponse};
use futures_util::StreamExt;

use super::stream_thread::StreamThread;

/// Headers of Webots' answer that are forwarded to the client.
const FORWARDED_HEADERS: [HeaderName; 4] = [
    header::CONTENT_TYPE,
    header::ETAG,
    header::CACHE_CONTROL,
    header::LAST_MODIFIED,
];

/// Reaches simulations on this machine; one per worker.
pub struct Upstream {
    client: awc::Client,
    address: IpAddr,
    /// Copies all streams.
    pub(super) stream_thread: Arc<StreamThread>,
    /// Time for which a simulation may leave sent data unread. Until then it goes unnoticed that its client has left.
    pub(super) silence: Duration,
    /// Timeout of a simulation's answer to a request for a file.
    answer: Duration,
}

/// The response if a simulation ends, or sends no valid answer.
pub(super) fn no_answer() -> HttpResponse {
    HttpResponse::BadGateway().body("Error: the simulation does not answer.")
}

impl Upstream {
    /// Reaches simulations at this address, and copies their streams on this thread. A simulation has `silence` to read
    /// what was sent to it, and `answer` to answer a request for a file.
    pub fn new(address: IpAddr, stream_thread: Arc<StreamThread>, silence: Duration, answer: Duration) -> Self {
        let connector = awc::Connector::new().limit(0);
        // Redirects are not followed, and the transfer of an answer may take as long as the simulation.
        let client = awc::Client::builder()
            .connector(connector)
            .disable_timeout()
            .disable_redirects();
        Self {
            client: client.no_default_headers().finish(),
            address,
            stream_thread,
            silence,
            answer,
        }
    }

    /// The address of the simulation with this port.
    pub(super) fn simulation(&self, port: u16) -> SocketAddr {
        SocketAddr::from((self.address, port))
    }

    /// Fetches a file of the simulation with this port, or its video, and forwards the answer as fast as the client reads it.
    /// `held` is dropped with the answer.
    pub async fn fetch(&self, port: u16, file: &str, request: &HttpRequest, held: impl std::any::Any) -> HttpResponse {
        // A connection that is kept alive could reach another simulation on the same port later.
        // Webots compares header names case-sensitively (WbTcpServer.cpp of R2025a).
        let url = format!("http://{}{file}", self.simulation(port));
        let mut query = self.client.get(url).no_decompress().force_close().camel_case();
        if let Some(tag) = request.headers().get(header::IF_NONE_MATCH) {
            query = query.insert_header((header::IF_NONE_MATCH, tag));
        }
        let answer = match timeout(self.answer, query.send()).await {
            Ok(Ok(answer)) if !answer.status().is_informational() => answer,
            Ok(_) => return no_answer(),
            Err(_) => {
                let seconds = self.answer.as_secs_f64();
                let words = format!("Error: the simulation is busy, and did not send this file within {seconds} s.");
                return HttpResponse::GatewayTimeout().body(words);
            }
        };
        let mut response = HttpResponse::build(answer.status());
        for name in FORWARDED_HEADERS {
            if let Some(value) = answer.headers().get(&name) {
                response.insert_header((name, value));
            }
        }
        // Worlds provide the content: it gets an origin of its own, so that it can't act as a page of this server, and
        // sends no referrer, because its URL contains the token.
        response.insert_header((header::CONTENT_SECURITY_POLICY, "sandbox allow-scripts"));
        response.insert_header((header::REFERRER_POLICY, "no-referrer"));
        if matches!(answer.status(), StatusCode::NO_CONTENT | StatusCode::NOT_MODIFIED) {
            return response.finish();
        }
        let length = answer
            .headers()
            .get(header::CONTENT_LENGTH)
            .and_then(|length| length.to_str().ok()?.parse().ok());
        if let Some(length) = length {
            response.no_chunking(length);
        }
        response.streaming(answer.map(move |part| {
            let _ = &held;
            part
        }))
    }
}
