//! A stand-in for a session server, a simulation server and Webots in one, which answers as a test demands.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::TlsAcceptor;
use tokio_tungstenite::accept_async;
use tokio_tungstenite::tungstenite::Message;

use super::authority::Certificate;

/// The answers. `{}` stands for `HOST:PORT`.
#[derive(Clone)]
pub struct Script {
    /// The answers of `/session` in order; the last one is repeated.
    pub session: Vec<&'static str>,
    /// The code of a reason in the header of these answers.
    pub reason: Option<&'static str>,
    /// The texts on `/client`; after them, `.` is sent repeatedly.
    pub client: Vec<&'static str>,
    /// The texts on `/webots`; after them, updates with the simulated time.
    pub webots: Vec<&'static str>,
}

impl Default for Script {
    /// A running simulation.
    fn default() -> Self {
        Self {
            session: vec!["ws://{}"],
            reason: None,
            client: vec!["shutdownTimeout: 60", "webots:ws://{}/webots"],
            webots: vec!["model:<Scene/>", "paused by client"],
        }
    }
}

/// The stand-in, as long as the test runs.
pub struct StandIn {
    /// `HOST:PORT`.
    pub address: String,
    asked: Arc<Mutex<Vec<String>>>,
}

/// What each connection needs.
#[derive(Clone)]
struct Part {
    script: Script,
    address: String,
    asked: Arc<Mutex<Vec<String>>>,
}

impl StandIn {
    /// Starts a stand-in over HTTP.
    pub async fn start(script: Script) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        Self::serve(script, listener, address)
    }

    /// Starts a stand-in that is reachable only over TLS, with this certificate for `localhost`.
    pub async fn start_behind_tls(script: Script, certificate: &Certificate) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let door = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("localhost:{}", door.local_addr().unwrap().port());
        let behind = listener.local_addr().unwrap();
        let acceptor = TlsAcceptor::from(certificate.server());
        actix_rt::spawn(async move {
            while let Ok((socket, _)) = door.accept().await {
                let acceptor = acceptor.clone();
                actix_rt::spawn(async move {
                    // A client that does not trust the certificate closes the connection.
                    let Ok(mut outside) = acceptor.accept(socket).await else {
                        return;
                    };
                    let mut inside = TcpStream::connect(behind).await.unwrap();
                    tokio::io::copy_bidirectional(&mut outside, &mut inside).await.ok();
                });
            }
        });
        Self::serve(script, listener, address)
    }

    fn serve(script: Script, listener: TcpListener, address: String) -> Self {
        let asked = Arc::default();
        let part = Part {
            script,
            address: address.clone(),
            asked: Arc::clone(&asked),
        };
        actix_rt::spawn(async move {
            while let Ok((socket, _)) = listener.accept().await {
                actix_rt::spawn(part.clone().answer(socket));
            }
        });
        Self { address, asked }
    }

    /// The requested paths that begin like this, in order.
    pub fn asked(&self, begin: &str) -> Vec<String> {
        self.asked
            .lock()
            .unwrap()
            .iter()
            .filter(|path| path.starts_with(begin))
            .cloned()
            .collect()
    }
}

impl Part {
    async fn answer(self, mut socket: TcpStream) -> Option<()> {
        let mut buffer = vec![0; 8192];
        let (head, length) = loop {
            let length = socket.peek(&mut buffer).await.ok().filter(|length| *length > 0)?;
            let head = String::from_utf8_lossy(&buffer[..length]).into_owned();
            if head.contains("\r\n\r\n") {
                break (head, length);
            }
            actix_rt::time::sleep(Duration::from_millis(5)).await;
        };
        let path = head.split(' ').nth(1)?.to_owned();
        let before = {
            let mut asked = self.asked.lock().unwrap();
            asked.push(path.clone());
            asked
                .iter()
                .filter(|one| one.starts_with("/session"))
                .count()
                .saturating_sub(1)
        };
        if head.to_lowercase().contains("upgrade: websocket") {
            return self.talk(socket, &path).await;
        }
        socket.read_exact(&mut buffer[..length]).await.ok()?;
        let content = match path.as_str() {
            "/load" => "1.0".to_owned(),
            _ => self.fill(self.script.session[before.min(self.script.session.len() - 1)]),
        };
        let reason = self.script.reason.map(|code| format!("\r\nWebots-Reason: {code}"));
        let head = format!(
            "HTTP/1.1 200 OK\r\nContent-Length: {}\r\nConnection: close{}",
            content.len(),
            reason.unwrap_or_default()
        );
        socket
            .write_all(format!("{head}\r\n\r\n{content}").as_bytes())
            .await
            .ok()
    }

    async fn talk(self, socket: TcpStream, path: &str) -> Option<()> {
        let mut socket = accept_async(socket).await.ok()?;
        let texts = match path {
            "/" => &vec!["1"],
            "/client" => &self.script.client,
            _ => &self.script.webots,
        };
        for text in texts {
            socket.send(Message::text(self.fill(text))).await.ok()?;
        }
        let mut time = 0;
        loop {
            tokio::select! {
                heard = socket.next() => if !matches!(heard, Some(Ok(Message::Text(_)))) { return None },
                () = actix_rt::time::sleep(Duration::from_millis(50)) => {
                    time += 50;
                    let text = match path {
                        "/" => continue,
                        "/client" => ".".to_owned(),
                        _ => format!("application/json:{{\"time\":{time}}}"),
                    };
                    socket.send(Message::text(text)).await.ok()?;
                }
            }
        }
    }

    fn fill(&self, text: &str) -> String {
        text.replace("{}", &self.address)
    }
}
