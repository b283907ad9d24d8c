//! Stand-ins for simulation servers: correct ones, ones like the Python servers, and misbehaving ones.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio_util::sync::CancellationToken;

use crate::support::raise_file_limit;

/// How a stand-in answers.
#[derive(Debug, Clone)]
pub enum Manner {
    /// Answers `/status` with this.
    Status(Value),
    /// Has no `/status`; answers `/load` with this, as Python servers do.
    Load(String),
    /// Answers every request with this status and body.
    Body(u16, Vec<u8>),
    /// Sends these bytes and closes the connection.
    Raw(Vec<u8>),
    /// Has no `/status`; answers `/load` with these bytes and closes the connection.
    RawLoad(Vec<u8>),
    /// Answers a request for `simulations.csv` with these bytes and closes the connection; has a `/load`.
    RawRecords(Vec<u8>),
    /// Accepts connections and sends nothing.
    Hang,
    /// Accepts connections and resets them.
    Reset,
    /// Sends an endless answer byte by byte.
    Drip,
}

impl Manner {
    /// A status with this load and this many slots, all free.
    pub fn idle(load: f64, places: u32) -> Self {
        Self::status(load, 0, places)
    }

    /// A status with this load, `running` simulations and this many slots.
    pub fn status(load: f64, running: u32, places: u32) -> Self {
        let instances = json!({"queued": 0, "starting": 0, "idle": 0, "running": running, "places": places,
            "arrivals": running});
        Self::Status(json!({"version": "stand-in", "load": load, "instances": instances}))
    }

    /// A status that allows one owner's worlds and no others.
    pub fn of_owner(owner: &str) -> Self {
        let instances = json!({"places": 100});
        let allowed = [format!("https://github.com/{owner}")];
        Self::Status(json!({"load": 1, "instances": instances, "docker": false, "allowedRepositories": allowed}))
    }
}

/// A stand-in. Its port refuses connections when it is dropped.
pub struct StandIn {
    address: SocketAddr,
    shared: Arc<Shared>,
    end: CancellationToken,
}

struct Shared {
    manner: Mutex<Manner>,
    connections: AtomicUsize,
    requests: AtomicUsize,
    /// The token of the last request that had one.
    token: Mutex<Option<String>>,
}

impl StandIn {
    /// Starts one on any free port.
    pub fn start(manner: Manner) -> Self {
        Self::start_on(([127, 0, 0, 1], 0).into(), manner)
    }

    /// Starts one on this address of the loopback.
    pub fn start_on(address: SocketAddr, manner: Manner) -> Self {
        // A test may start a thousand of them.
        raise_file_limit();
        let socket = if address.is_ipv6() {
            TcpSocket::new_v6()
        } else {
            TcpSocket::new_v4()
        }
        .unwrap();
        socket.set_reuseaddr(true).unwrap();
        socket.bind(address).unwrap();
        let listener = socket.listen(1024).unwrap();
        let address = listener.local_addr().unwrap();
        let shared = Arc::new(Shared {
            manner: Mutex::new(manner),
            connections: AtomicUsize::new(0),
            requests: AtomicUsize::new(0),
            token: Mutex::default(),
        });
        let end = CancellationToken::new();
        let serving = serve(listener, Arc::clone(&shared), end.clone());
        actix_rt::spawn(end.clone().run_until_cancelled_owned(serving));
        Self { address, shared, end }
    }

    /// `HOST:PORT`.
    pub fn address(&self) -> String {
        self.address.to_string()
    }

    /// The URL that the session server sends to a client that it assigns here.
    pub fn url(&self) -> String {
        format!("ws://{}", self.address())
    }

    /// Changes its behaviour from now on; a connection that hangs keeps hanging.
    pub fn set(&self, manner: Manner) {
        *self.shared.manner.lock().unwrap() = manner;
    }

    /// The number of connections accepted so far.
    pub fn connections(&self) -> usize {
        self.shared.connections.load(Ordering::SeqCst)
    }

    /// The token (RFC 6750) of the last request that had one.
    pub fn token(&self) -> Option<String> {
        self.shared.token.lock().unwrap().clone()
    }

    /// The number of requests received so far.
    pub fn requests(&self) -> usize {
        self.shared.requests.load(Ordering::SeqCst)
    }
}

impl Drop for StandIn {
    fn drop(&mut self) {
        self.end.cancel();
    }
}

async fn serve(listener: TcpListener, shared: Arc<Shared>, end: CancellationToken) {
    while let Ok((stream, _)) = listener.accept().await {
        shared.connections.fetch_add(1, Ordering::SeqCst);
        let shared = Arc::clone(&shared);
        actix_rt::spawn(
            end.clone()
                .run_until_cancelled_owned(async move { converse(stream, &shared).await }),
        );
    }
}

/// Answers requests on one connection until it ends.
async fn converse(mut stream: TcpStream, shared: &Shared) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    while let Some(head) = next_request(&mut stream).await? {
        let path = head.split(' ').nth(1).unwrap_or_default().to_owned();
        if let Some((_, rest)) = head.split_once("Bearer ") {
            *shared.token.lock().unwrap() = rest.lines().next().map(str::to_owned);
        }
        shared.requests.fetch_add(1, Ordering::SeqCst);
        let manner = shared.manner.lock().unwrap().clone();
        if !answer(&mut stream, &path, manner).await? {
            break;
        }
    }
    Ok(())
}

/// The head of the next request; `None` at the end of the connection.
async fn next_request(stream: &mut TcpStream) -> std::io::Result<Option<String>> {
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        if stream.read_buf(&mut head).await? == 0 {
            return Ok(None);
        }
    }
    Ok(Some(String::from_utf8_lossy(&head).into_owned()))
}

/// Answers one request; returns whether the connection stays open.
async fn answer(stream: &mut TcpStream, path: &str, manner: Manner) -> std::io::Result<bool> {
    match manner {
        Manner::Status(status) if path == "/status" => send(stream, 200, status.to_string().as_bytes()).await?,
        Manner::Load(load) if path == "/load" => send(stream, 200, load.as_bytes()).await?,
        Manner::RawLoad(bytes) if path == "/load" => {
            stream.write_all(&bytes).await?;
            return Ok(false);
        }
        Manner::RawRecords(_) if path == "/load" => send(stream, 200, b"3.0").await?,
        Manner::RawRecords(bytes) if path.starts_with("/simulations.csv") => {
            stream.write_all(&bytes).await?;
            return Ok(false);
        }
        Manner::Status(_) | Manner::Load(_) | Manner::RawLoad(_) | Manner::RawRecords(_) => {
            send(stream, 404, b"404: Not Found").await?
        }
        Manner::Body(status, body) => send(stream, status, &body).await?,
        Manner::Raw(bytes) => {
            stream.write_all(&bytes).await?;
            return Ok(false);
        }
        Manner::Hang => std::future::pending().await,
        Manner::Reset => {
            stream.set_zero_linger()?;
            return Ok(false);
        }
        Manner::Drip => {
            stream
                .write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n")
                .await?;
            loop {
                stream.write_all(b" ").await?;
                actix_rt::time::sleep(Duration::from_millis(20)).await;
            }
        }
    }
    Ok(true)
}

async fn send(stream: &mut TcpStream, status: u16, body: &[u8]) -> std::io::Result<()> {
    let head = format!("HTTP/1.1 {status} -\r\nContent-Length: {}\r\n\r\n", body.len());
    stream.write_all(&[head.as_bytes(), body].concat()).await
}
