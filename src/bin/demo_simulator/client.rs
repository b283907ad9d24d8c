//! One WebSocket, as a task: it hands the peer's texts to the simulation, as events, and sends the peer what the
//! simulation queues in its `ClientHandle`.
//!
//! Queues are bounded. The next text of a peer is read once the simulation has handled the last one. A peer that does
//! not read is disconnected once its queue is full.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use actix::{Message, Recipient};
use bytestring::ByteString;
use futures_util::future::{AbortHandle, abortable};
use futures_util::{SinkExt as _, StreamExt as _};
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message as Frame;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;

/// Limit of texts that wait to be sent to the peer.
const MAX_OUTGOING: usize = 64;
/// Limit of updates of poses among these.
const MAX_UPDATES: usize = 4;

/// Identifies a connection; unique in a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ClientId(u64);

/// A message from the simulation to a client.
enum Outgoing {
    Text(ByteString, Option<OwnedSemaphorePermit>),
    Close,
}

/// An event of a connection.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) enum Event {
    /// It was opened.
    Connected(ClientId, ClientHandle),
    /// The peer has sent a text.
    Received(ClientId, ByteString),
    /// It is closed.
    Disconnected(ClientId),
}

/// The simulation's handle of a client.
pub(crate) struct ClientHandle {
    queue: mpsc::Sender<Outgoing>,
    updates: Arc<Semaphore>,
    task: AbortHandle,
}

impl ClientHandle {
    /// Queues a text. Returns false if the queue is full or the client has disconnected.
    pub(crate) fn send(&self, text: ByteString) -> bool {
        self.queue.try_send(Outgoing::Text(text, None)).is_ok()
    }

    /// Queues an update of poses. Returns false if too many wait already.
    pub(crate) fn send_update(&self, text: ByteString) -> bool {
        let permit = Arc::clone(&self.updates).try_acquire_owned();
        permit.is_ok_and(|permit| self.queue.try_send(Outgoing::Text(text, Some(permit))).is_ok())
    }

    /// Starts the closing handshake, after the queued texts. A client whose queue is full is disconnected.
    pub(crate) fn close(&self) {
        if self.queue.try_send(Outgoing::Close).is_err() {
            self.disconnect();
        }
    }

    /// Disconnects the client without sending the queued texts.
    pub(crate) fn disconnect(&self) {
        self.task.abort();
    }
}

/// Exchanges texts between a peer and the simulation until one of them closes the connection.
pub(crate) async fn serve(socket: WebSocketStream<TcpStream>, simulation: Recipient<Event>) {
    static NEXT_ID: AtomicU64 = AtomicU64::new(1);
    let id = ClientId(NEXT_ID.fetch_add(1, Ordering::Relaxed));
    let (queue, outgoing) = mpsc::channel(MAX_OUTGOING);
    let (exchange, task) = abortable(exchange(id, socket, outgoing, simulation.clone()));
    let handle = ClientHandle {
        queue,
        updates: Arc::new(Semaphore::new(MAX_UPDATES)),
        task,
    };
    simulation.do_send(Event::Connected(id, handle));
    exchange.await.ok();
    simulation.do_send(Event::Disconnected(id));
}

async fn exchange(
    id: ClientId,
    mut socket: WebSocketStream<TcpStream>,
    mut outgoing: mpsc::Receiver<Outgoing>,
    simulation: Recipient<Event>,
) {
    loop {
        tokio::select! {
            frame = socket.next() => match frame {
                Some(Ok(Frame::Text(text))) => {
                    let event = Event::Received(id, ByteString::from(text.as_str()));
                    if simulation.send(event).await.is_err() {
                        return;
                    }
                }
                // Pings and close frames were answered already; the stream ends when the closing handshake is complete.
                Some(Ok(Frame::Ping(_) | Frame::Pong(_) | Frame::Close(_) | Frame::Frame(_))) => {}
                Some(Ok(Frame::Binary(_))) => return close(&mut socket, CloseCode::Unsupported).await,
                Some(Err(_)) | None => return,
            },
            Some(message) = outgoing.recv() => match message {
                Outgoing::Text(text, permit) => {
                    if socket.send(Frame::text(&*text)).await.is_err() {
                        return;
                    }
                    drop(permit);
                }
                // As Webots at its end.
                Outgoing::Close => return close(&mut socket, CloseCode::Away).await,
            },
        }
    }
}

/// Sends a close frame, and waits for the peer's.
async fn close(socket: &mut WebSocketStream<TcpStream>, code: CloseCode) {
    let frame = CloseFrame {
        code,
        reason: "".into(),
    };
    if socket.close(Some(frame)).await.is_ok() {
        while let Some(Ok(_)) = socket.next().await {}
    }
}
