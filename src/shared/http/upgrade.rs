//! Takes a client's connection from actix once its request was answered with 101 (Switching Protocols), as
//! `hyper::upgrade` does: bytes that are only copied need no parser of HTTP between.

use std::cell::RefCell;
use std::rc::Rc;

use actix_web::HttpRequest;
use actix_web::rt::net::TcpStream;
use tokio::sync::oneshot;

use super::connections::ConnectionPermit;

/// A connection that speaks another protocol than HTTP from now on.
#[derive(Debug)]
pub struct Upgraded {
    /// The connection.
    pub tcp: TcpStream,
    /// What was read from it after the request.
    pub read_buffer: Vec<u8>,
    /// Counts the connection.
    pub permit: ConnectionPermit,
}

/// Where a connection goes when it is upgraded. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct UpgradeSlot(Rc<RefCell<Option<oneshot::Sender<Upgraded>>>>);

impl UpgradeSlot {
    /// Whether somebody waits for the connection.
    pub fn is_wanted(&self) -> bool {
        self.0.borrow().is_some()
    }

    /// Hands the connection over.
    pub fn fulfil(&self, upgraded: Upgraded) {
        if let Some(receiver) = self.0.borrow_mut().take() {
            // Without a receiver the connection closes.
            receiver.send(upgraded).ok();
        }
    }
}

/// The connection of a request, once the answer 101 was written to it. An error means that it has ended before.
pub fn on(request: &HttpRequest) -> oneshot::Receiver<Upgraded> {
    let (sender, receiver) = oneshot::channel();
    if let Some(slot) = request.conn_data::<UpgradeSlot>() {
        slot.0.replace(Some(sender));
    }
    receiver
}
