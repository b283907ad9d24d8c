//! A web server that takes what is posted to it, and answers as a test says.

use std::sync::Arc;

use parking_lot::Mutex;
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use serde_json::Value;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::TlsAcceptor;

use super::authority::Certificate;
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
    /// One that speaks plainly, or with a certificate.
    pub async fn start(certificate: Option<&Certificate>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let (posted, answer) = (Arc::default(), Arc::new(Mutex::new("200 OK".to_owned())));
        let receiver = Self { port, posted: Arc::clone(&posted), answer: Arc::clone(&answer) };
        let acceptor = certificate.map(acceptor);
        actix_rt::spawn(async move {
            while let Ok((socket, _)) = listener.accept().await {
                actix_rt::spawn(serve(socket, acceptor.clone(), Arc::clone(&posted), Arc::clone(&answer)));
            }
        });
        receiver
    }

    /// Answers so from now on: the status, and headers after a line break.
    pub fn answer(&self, answer: &str) {
        *self.answer.lock() = answer.to_owned();
    }

    /// All that was posted.
    pub fn posted(&self) -> Vec<Posted> {
        self.posted.lock().clone()
    }

    /// The texts of the first so many requests, once they have come.
    pub async fn texts(&self, count: usize) -> Vec<String> {
        until(&format!("{count} were posted"), async || self.posted().len() >= count).await;
        let text = |posted: &Posted| posted.body["text"].as_str().unwrap().to_owned();
        self.posted().iter().map(text).collect()
    }
}

fn acceptor(certificate: &Certificate) -> TlsAcceptor {
    let chain = vec![CertificateDer::from_pem_file(&certificate.chain).unwrap()];
    let key = PrivateKeyDer::from_pem_file(&certificate.key).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ServerConfig::builder_with_provider(provider).with_safe_default_protocol_versions().unwrap();
    TlsAcceptor::from(Arc::new(config.with_no_client_auth().with_single_cert(chain, key).unwrap()))
}

async fn serve(
    socket: TcpStream,
    acceptor: Option<TlsAcceptor>,
    posted: Arc<Mutex<Vec<Posted>>>,
    answer: Arc<Mutex<String>>,
) {
    match acceptor {
        None => drop(take(socket, &posted, &answer).await),
        Some(acceptor) => {
            // Who does not trust the certificate breaks off.
            let Ok(socket) = acceptor.accept(socket).await else { return };
            take(socket, &posted, &answer).await;
        }
    }
}

async fn take(
    mut socket: impl AsyncRead + AsyncWrite + Unpin,
    posted: &Mutex<Vec<Posted>>,
    answer: &Mutex<String>,
) -> Option<()> {
    let mut read = Vec::new();
    let (head, length) = loop {
        if socket.read_buf(&mut read).await.ok()? == 0 {
            return None;
        }
        if let Some((head, _)) = String::from_utf8_lossy(&read).split_once("\r\n\r\n") {
            let line = head.lines().find_map(|line| line.to_lowercase().strip_prefix("content-length: ")?.parse().ok());
            break (head.to_owned(), line.unwrap_or(0));
        }
    };
    while read.len() < head.len() + 4 + length {
        socket.read_buf(&mut read).await.ok().filter(|count| *count > 0)?;
    }
    assert!(head.to_lowercase().contains("content-type: application/json"), "{head}");
    let body = serde_json::from_slice(&read[head.len() + 4..]).unwrap();
    posted.lock().push(Posted { line: head.lines().next().unwrap().to_owned(), body });
    let answer = answer.lock().clone();
    let text = format!("HTTP/1.1 {answer}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    socket.write_all(text.as_bytes()).await.ok()
}
