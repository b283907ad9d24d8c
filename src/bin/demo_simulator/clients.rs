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
    /// Dropped when the last client has disconnected.
    closing: Option<oneshot::Sender<()>>,
}

struct Connected {
    handle: ClientHandle,
    /// Whether it has requested the scene.
    watching: bool,
    /// Whether it read too slowly for the last update.
    missed_update: bool,
}

impl Clients {
    /// Adds a client, which gets no broadcasts yet.
    pub(crate) fn add(&mut self, id: ClientId, handle: ClientHandle) {
        self.connected.insert(
            id,
            Connected {
                handle,
                watching: false,
                missed_update: false,
            },
        );
    }

    /// Removes a disconnected client.
    pub(crate) fn remove(&mut self, id: ClientId) {
        self.connected.remove(&id);
        self.closing.take_if(|_| self.connected.is_empty());
    }

    /// Adds this client to the recipients of broadcasts.
    pub(crate) fn watch(&mut self, id: ClientId) {
        if let Some(client) = self.connected.get_mut(&id) {
            client.watching = true;
        }
    }

    /// Sends a text to one client.
    pub(crate) fn send(&mut self, id: ClientId, text: impl Into<ByteString>) {
        let text = text.into();
        self.send_where(&text, |client, _| client == id);
    }

    /// Sends a text to all clients that watch.
    pub(crate) fn broadcast(&mut self, text: impl Into<ByteString>) {
        self.send_where(&text.into(), |_, client| client.watching);
    }

    /// Sends an update to all clients that watch and read fast enough.
    pub(crate) fn broadcast_update(&mut self, text: impl Into<ByteString>) {
        let text = text.into();
        for client in self.connected.values_mut().filter(|client| client.watching) {
            client.missed_update = !client.handle.send_update(text.clone());
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
