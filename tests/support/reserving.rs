//! A stand-in for a simulation server that reserves slots for the line: it answers `/status`, and on `/slots` a test
//! says what it does.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, accept_async};
use webots_fleet::shared::domain::{
    Hello, Offer, Offers, ReadyCount, ReservationId, ServerRun, ToSimulationServer, Wishes,
};

use super::SOON;

/// The stand-in, as long as the test runs.
pub struct ReservingServer {
    /// `HOST:PORT`.
    pub address: String,
    status: Arc<Mutex<Value>>,
    links: UnboundedReceiver<SlotSocket>,
    breaks: Arc<AtomicUsize>,
}

/// The connection of a session server, which has proved that it has the key.
pub struct SlotSocket(WebSocketStream<TcpStream>);

/// The status of a server with these slots, which reserves them.
fn status(taken: u32, slots: u32) -> Value {
    json!({"load": 1, "version": "stand-in", "reserves": true, "instances": {"running": taken, "places": slots}})
}

impl ReservingServer {
    /// Starts one with this many slots, all free. Its reservations hold for `pass` seconds, as it says.
    pub async fn start(slots: u32, pass: f64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let status = Arc::new(Mutex::new(status(0, slots)));
        let breaks = Arc::new(AtomicUsize::new(0));
        let (sender, links) = unbounded_channel();
        let (shared, broken) = (Arc::clone(&status), Arc::clone(&breaks));
        actix_rt::spawn(async move {
            while let Ok((socket, _)) = listener.accept().await {
                let answered = answer(socket, Arc::clone(&shared), Arc::clone(&broken), sender.clone(), pass);
                actix_rt::spawn(answered);
            }
        });
        Self {
            address,
            status,
            links,
            breaks,
        }
    }

    /// The next so many connections break after the proof.
    pub fn break_next(&self, count: usize) {
        self.breaks.store(count, Ordering::Relaxed);
    }

    /// How many connections have yet to break.
    pub fn breaks_left(&self) -> usize {
        self.breaks.load(Ordering::Relaxed)
    }

    /// Reports these slots from now on.
    pub fn report(&self, taken: u32, slots: u32) {
        *self.status.lock().unwrap() = status(taken, slots);
    }

    /// Reports this, too, from now on.
    pub fn report_also(&self, more: Value) {
        let mut status = self.status.lock().unwrap();
        status
            .as_object_mut()
            .unwrap()
            .extend(more.as_object().unwrap().clone());
    }

    /// The next session server that connects.
    pub async fn link(&mut self) -> SlotSocket {
        let link = actix_rt::time::timeout(SOON, self.links.recv()).await;
        link.expect("a session server connects").unwrap()
    }
}

impl SlotSocket {
    /// The next wishes, which come soon; `None` once the session server has gone.
    pub async fn wishes(&mut self) -> Option<Wishes> {
        let next = actix_rt::time::timeout(SOON, self.wishes_if_any()).await;
        next.expect("wishes, or an end")
    }

    /// As [`Self::wishes`], whenever they come.
    pub async fn wishes_if_any(&mut self) -> Option<Wishes> {
        loop {
            match self.0.next().await? {
                Ok(Message::Text(text)) => {
                    if let ToSimulationServer::Wishes(wishes) = serde_json::from_str(&text).ok()? {
                        return Some(wishes);
                    }
                }
                Ok(_) => {}
                Err(_) => return None,
            }
        }
    }

    /// The next list of what it is asked to keep ready, which comes soon.
    pub async fn keep_ready(&mut self) -> Vec<ReadyCount> {
        let list = async {
            loop {
                let message = self.0.next().await.unwrap().unwrap();
                let Message::Text(text) = message else { continue };
                if let ToSimulationServer::KeepReady(list) = serde_json::from_str(&text).unwrap() {
                    return list.keep_ready;
                }
            }
        };
        let next = actix_rt::time::timeout(SOON, list).await;
        next.expect("a list of what is to be kept ready")
    }

    /// Sends offers; returns whether the session server is still there.
    pub async fn offer(&mut self, offers: &Offers) -> bool {
        self.say(serde_json::to_string(offers).unwrap()).await
    }

    /// Sends any text; returns whether the session server is still there.
    pub async fn say(&mut self, text: String) -> bool {
        self.0.send(Message::text(text)).await.is_ok()
    }

    /// Sends so many pings, and waits until all are answered.
    pub async fn ping(&mut self, count: usize) {
        for _ in 0..count {
            self.0.send(Message::Ping(Default::default())).await.unwrap();
        }
        let mut answered = 0;
        let answers = async {
            while answered < count {
                answered += usize::from(self.0.next().await.unwrap().unwrap().is_pong());
            }
        };
        let waited = actix_rt::time::timeout(SOON, answers).await;
        waited.expect("each ping is answered");
    }

    /// Answers these wishes with a slot for each of these tickets.
    pub async fn reserve(&mut self, number: u64, tickets: impl IntoIterator<Item = u64>) -> bool {
        let offer = |ticket| Offer {
            ticket,
            reservation: ReservationId(ticket),
        };
        let offers = Offers {
            number,
            offers: tickets.into_iter().map(offer).collect(),
            ..Offers::default()
        };
        self.offer(&offers).await
    }
}

async fn answer(
    mut socket: TcpStream,
    status: Arc<Mutex<Value>>,
    breaks: Arc<AtomicUsize>,
    links: UnboundedSender<SlotSocket>,
    pass: f64,
) -> Option<()> {
    socket.set_nodelay(true).ok()?;
    let mut head = [0; 4096];
    loop {
        // A request is small enough to arrive in one piece.
        let length = socket.peek(&mut head).await.ok().filter(|length| *length > 0)?;
        let text = String::from_utf8_lossy(&head[..length]).to_lowercase();
        if text.contains("upgrade: websocket") {
            break;
        }
        socket.read_exact(&mut head[..length]).await.ok()?;
        let body = status.lock().unwrap().to_string();
        let answer = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n{body}", body.len());
        socket.write_all(answer.as_bytes()).await.ok()?;
    }
    let mut link = SlotSocket(accept_async(socket).await.ok()?);
    let hello = Hello {
        challenge: 1,
        server: ServerRun(2),
        pass,
        keeps_ready: true,
        roster: true,
    };
    link.say(serde_json::to_string(&hello).unwrap()).await;
    // Its proof.
    link.0.next().await?.ok()?;
    let left = breaks.load(Ordering::Relaxed);
    if left > 0 {
        breaks.store(left - 1, Ordering::Relaxed);
        return None;
    }
    link.offer(&Offers::default()).await;
    links.send(link).ok()
}
