//! Everybody who is connected, and what each may be sent: owned by the simulation. Keeps what waits for
//! a peer that reads slowly, or not at all, within bounds.

use std::collections::BTreeMap;

use actix_web_actors::ws::CloseCode;
use bytestring::ByteString;

use crate::client::{ClientId, Outbox};

/// With so many bytes waiting a client gets no more pose updates, until it has caught up.
const SLOW: usize = 64 * 1024;
/// With so many bytes waiting, beyond what it takes to show the world twice, a client is hopeless.
const HOPELESS: usize = 1024 * 1024;

/// Everybody who is connected.
#[derive(Default)]
pub(crate) struct Audience {
    connections: BTreeMap<ClientId, Connection>,
    /// What it takes to show the world, in bytes.
    scene_size: usize,
}

struct Connection {
    outbox: Outbox,
    /// Whether it has asked to see the scene.
    watching: bool,
    /// Whether it missed an update, so that the next one must name everything.
    missed: bool,
}

impl Audience {
    /// Someone connected.
    pub(crate) fn join(&mut self, id: ClientId, outbox: Outbox) {
        self.connections.insert(id, Connection { outbox, watching: false, missed: false });
    }

    /// Another world will be shown, which takes so many bytes.
    pub(crate) fn expect_scene_of(&mut self, bytes: usize) {
        self.scene_size = bytes;
    }

    /// Someone is gone.
    pub(crate) fn leave(&mut self, id: ClientId) {
        self.connections.remove(&id);
    }

    /// Someone wants to see the scene from now on.
    pub(crate) fn watch(&mut self, id: ClientId) {
        if let Some(connection) = self.connections.get_mut(&id) {
            connection.watching = true;
        }
    }

    /// Those who see the scene.
    pub(crate) fn watchers(&self) -> Vec<ClientId> {
        self.connections.iter().filter(|(_, connection)| connection.watching).map(|(id, _)| *id).collect()
    }

    /// Whether nobody sees the scene.
    pub(crate) fn is_blind(&self) -> bool {
        !self.connections.values().any(|connection| connection.watching)
    }

    /// Sends a text to one.
    pub(crate) fn tell(&mut self, id: ClientId, text: impl Into<ByteString>) {
        let patience = self.patience();
        if let Some(connection) = self.connections.get(&id)
            && !connection.send(text.into(), patience)
        {
            self.connections.remove(&id);
        }
    }

    /// Sends a text to all who see the scene.
    pub(crate) fn tell_watchers(&mut self, text: impl Into<ByteString>) {
        let text = text.into();
        let patience = self.patience();
        self.connections.retain(|_, connection| !connection.watching || connection.send(text.clone(), patience));
    }

    /// Sends an update to all who see the scene and read fast enough; `everything` makes the one for
    /// those who missed some before.
    pub(crate) fn show(&mut self, changes: impl Into<ByteString>, mut everything: impl FnMut() -> String) {
        let changes = changes.into();
        for connection in self.connections.values_mut().filter(|connection| connection.watching) {
            if connection.outbox.waiting() > SLOW {
                connection.missed = true;
            } else if std::mem::take(&mut connection.missed) {
                connection.outbox.send(everything().into());
            } else {
                connection.outbox.send(changes.clone());
            }
        }
    }

    /// Sends everything to those who missed an update, since time stops and no other will come.
    pub(crate) fn catch_up(&mut self, mut everything: impl FnMut() -> String) {
        let patience = self.patience();
        self.connections.retain(|_, connection| {
            !std::mem::take(&mut connection.missed) || connection.send(everything().into(), patience)
        });
    }

    /// Says goodbye to everybody.
    pub(crate) fn close(&mut self) {
        for connection in std::mem::take(&mut self.connections).into_values() {
            connection.outbox.close(CloseCode::Away);
        }
    }

    fn patience(&self) -> usize {
        HOPELESS + 2 * self.scene_size
    }
}

impl Connection {
    /// Sends a text that must arrive. To a client with more than `patience` bytes waiting it cannot: then
    /// the connection is broken, and false is returned.
    fn send(&self, text: ByteString, patience: usize) -> bool {
        if self.outbox.waiting() > patience {
            self.outbox.hang_up();
            return false;
        }
        self.outbox.send(text);
        true
    }
}
