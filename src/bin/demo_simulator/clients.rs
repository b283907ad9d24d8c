//! The connected clients, as the simulation sees them.

use std::collections::BTreeMap;
use std::mem;

use bytestring::ByteString;
use tokio::sync::oneshot;

use crate::client::{ClientHandle, ClientId};

/// The connected clients.
#[derive(Default)]
pub(crate) struct Clients {
    connected: BTreeMap<ClientId, Connected>,
    /// Texts of the console, each on a line, until the first client has requested a scene.
    console: Vec<String>,
    /// Whether a client has requested a scene.
    has_viewer: bool,
    /// Dropped when the last client has disconnected.
    closing: Option<oneshot::Sender<()>>,
}

struct Connected {
    handle: ClientHandle,
    /// Whether it read too slowly for the last update.
    missed_update: bool,
}

impl Clients {
    /// Adds a client.
    pub(crate) fn add(&mut self, id: ClientId, handle: ClientHandle) {
        self.connected.insert(
            id,
            Connected {
                handle,
                missed_update: false,
            },
        );
    }

    /// Removes a disconnected client.
    pub(crate) fn remove(&mut self, id: ClientId) {
        self.connected.remove(&id);
        self.closing.take_if(|_| self.connected.is_empty());
    }

    /// Whether no client is connected.
    pub(crate) fn is_empty(&self) -> bool {
        self.connected.is_empty()
    }

    /// Sends the texts of the console that wait, and later ones at once: a client has requested a scene.
    pub(crate) fn start_console(&mut self) {
        self.has_viewer = true;
        self.send_console();
    }

    /// Sends a text of the console to all clients, once one of them has requested a scene.
    pub(crate) fn log(&mut self, text: String) {
        self.console.push(text);
        self.send_console();
    }

    /// All texts go in one message, which waits for a client.
    fn send_console(&mut self) {
        if self.has_viewer && !self.console.is_empty() && !self.connected.is_empty() {
            let texts = mem::take(&mut self.console);
            self.broadcast(texts.join("\n"));
        }
    }

    /// Sends a text to one client.
    pub(crate) fn send(&mut self, id: ClientId, text: impl Into<ByteString>) {
        let text = text.into();
        self.send_where(&text, |client, _| client == id);
    }

    /// Sends a text to all clients, those too that have requested nothing.
    pub(crate) fn broadcast(&mut self, text: impl Into<ByteString>) {
        self.send_where(&text.into(), |_, _| true);
    }

    /// Sends an update to all clients that read fast enough. Those that missed one before get the whole `state`.
    pub(crate) fn broadcast_update(&mut self, text: impl Into<ByteString>, state: impl Fn() -> String) {
        let text = text.into();
        for client in self.connected.values_mut() {
            let text = if client.missed_update {
                state().into()
            } else {
                text.clone()
            };
            client.missed_update = !client.handle.send_update(text);
        }
    }

    /// Sends an update to the clients that missed the last one.
    pub(crate) fn send_missed_update(&mut self, text: impl Into<ByteString>) {
        self.send_where(&text.into(), |_, client| mem::take(&mut client.missed_update));
    }

    /// Starts the closing handshake with every client. The returned channel is closed when all have disconnected.
    pub(crate) fn close(&mut self) -> oneshot::Receiver<()> {
        let (closing, closed) = oneshot::channel();
        self.closing = Some(closing).filter(|_| !self.connected.is_empty());
        for client in self.connected.values() {
            client.handle.close();
        }
        closed
    }

    /// Sends a text to some clients. Disconnects those whose queue is full.
    fn send_where(&mut self, text: &ByteString, mut is_meant: impl FnMut(ClientId, &mut Connected) -> bool) {
        self.connected.retain(|id, client| {
            let is_alive = !is_meant(*id, client) || client.handle.send(text.clone());
            if !is_alive {
                client.handle.disconnect();
            }
            is_alive
        });
    }
}
