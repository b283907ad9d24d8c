//! A stand-in for a browser: https pages and wss connections, from any loopback address.

use std::net::SocketAddr;
use std::sync::Arc;

use rustls::ClientConfig;
use tokio::net::TcpSocket;
use tokio_tungstenite::tungstenite::Error;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::{Connector, client_async_tls_with_config};

use crate::support::SOON;
use crate::support::client::Client;
use crate::support::http::Answer;

/// A page whose head has been received.
pub type Page = awc::ClientResponse;

/// A browser on a machine with this address.
#[derive(Clone)]
pub struct Browser {
    pub address: &'static str,
    pub trust: Arc<ClientConfig>,
    /// The web server, as `localhost:PORT`, and the port of its plain HTTP.
    pub host: String,
    pub plain: u16,
}

impl Browser {
    /// The same browser at another address.
    pub fn at(&self, address: &'static str) -> Self {
        Self {
            address,
            ..self.clone()
        }
    }

    /// Gets a page of `https://HOST`.
    pub async fn get(&self, path: &str) -> Answer {
        self.ask(&format!("https://{}{path}", self.host), &[]).await
    }

    /// Requests a page, whose body may be endless.
    pub async fn begin(&self, url: &str, headers: &[(&str, &str)]) -> Page {
        let connector = awc::Connector::new()
            .rustls_0_23(self.trust.clone())
            .local_address(self.address.parse().unwrap());
        let client = awc::Client::builder()
            .connector(connector)
            .timeout(SOON)
            .disable_redirects()
            .finish();
        let mut request = client.get(url);
        for &header in headers {
            request = request.insert_header(header);
        }
        request.send().await.unwrap_or_else(|error| panic!("{url}: {error}"))
    }

    /// Gets a page of any server, with headers.
    pub async fn ask(&self, url: &str, headers: &[(&str, &str)]) -> Answer {
        let mut answer = self.begin(url, headers).await;
        let body = answer.body().await.unwrap_or_else(|error| panic!("{url}: {error}"));
        Answer {
            status: answer.status(),
            headers: answer.headers().clone(),
            body,
        }
    }

    /// Asserts that a path serves neither a page nor a WebSocket.
    pub async fn finds_nothing(&self, path: &str) {
        let answer = self.get(path).await;
        assert!(
            [400, 403, 404].contains(&answer.status.as_u16()),
            "{path}: {}",
            answer.status
        );
        assert!(!answer.text().contains("secret"), "{path}");
        assert!(
            self.try_open(&format!("wss://{}{path}", self.host), &[]).await.is_err(),
            "{path}"
        );
    }

    /// Opens a WebSocket of `wss://HOST`.
    pub async fn connect(&self, path: &str) -> Client {
        self.open(&format!("wss://{}{path}", self.host)).await
    }

    /// Opens a WebSocket at a URL that a server sent.
    pub async fn open(&self, url: &str) -> Client {
        self.try_open(url, &[])
            .await
            .unwrap_or_else(|error| panic!("{url}: {error}"))
    }

    /// Opens a WebSocket with headers; it may be refused.
    pub async fn try_open(&self, url: &str, headers: &[(&'static str, &str)]) -> Result<Client, Box<Error>> {
        let mut request = url.into_client_request().unwrap();
        for (name, value) in headers {
            request.headers_mut().append(*name, value.parse().unwrap());
        }
        let port = request.uri().port_u16().unwrap();
        let socket = TcpSocket::new_v4().unwrap();
        socket.bind(SocketAddr::new(self.address.parse().unwrap(), 0)).unwrap();
        let stream = socket.connect(SocketAddr::from(([127, 0, 0, 1], port))).await.unwrap();
        let connector = Connector::Rustls(self.trust.clone());
        let opening = client_async_tls_with_config(request, stream, None, Some(connector));
        let (socket, _) = actix_rt::time::timeout(SOON, opening).await.expect("no answer")?;
        Ok(Client::new(socket))
    }
}
