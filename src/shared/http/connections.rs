//! How many WebSockets may be open: in all, and per client address.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use actix_web::HttpResponse;
use actix_web::http::StatusCode;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::paths::retry_after;
use super::peer::Peer;

/// Counts open connections.
#[derive(Debug)]
pub struct Connections {
    all: Arc<Semaphore>,
    most: usize,
    per_address: usize,
    taken: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

/// One connection. Dropping it makes room for another.
#[derive(Debug)]
pub struct Connection {
    _permit: OwnedSemaphorePermit,
    _place: Option<Place>,
}

/// A connection among those of its address.
#[derive(Debug)]
struct Place {
    address: IpAddr,
    taken: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

/// Why a connection is refused. The words are for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Crowded {
    /// The server is full.
    #[error("Error: too many connections.")]
    Everywhere,
    /// The client's address is.
    #[error("Error: too many connections from your address.")]
    FromThere,
}

impl Connections {
    /// So many in all, and so many per address.
    #[must_use]
    pub fn new(most: usize, per_address: usize) -> Self {
        Self { all: Arc::new(Semaphore::new(most)), most, per_address, taken: Arc::default() }
    }

    /// How many there are.
    #[must_use]
    pub fn count(&self) -> usize {
        self.most.saturating_sub(self.all.available_permits())
    }

    /// Admits a connection. A proxy that says nothing of its clients stands for many: it is counted among all alone.
    ///
    /// # Errors
    /// When there are too many connections.
    pub fn admit(&self, peer: Peer) -> Result<Connection, Crowded> {
        let permit = Arc::clone(&self.all).try_acquire_owned().map_err(|_| Crowded::Everywhere)?;
        let place = peer.rate_limit_key().map(|address| self.place(address)).transpose()?;
        Ok(Connection { _permit: permit, _place: place })
    }

    fn place(&self, address: IpAddr) -> Result<Place, Crowded> {
        let mut taken = lock(&self.taken);
        let count = taken.entry(address).or_default();
        if *count >= self.per_address {
            return Err(Crowded::FromThere);
        }
        *count += 1;
        Ok(Place { address, taken: Arc::clone(&self.taken) })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = lock(&self.taken);
        if let Some(count) = taken.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                taken.remove(&self.address);
            }
        }
    }
}

impl Crowded {
    /// The answer to a client that is refused.
    #[must_use]
    pub fn answer(self) -> HttpResponse {
        let status = match self {
            Self::Everywhere => StatusCode::SERVICE_UNAVAILABLE,
            Self::FromThere => StatusCode::TOO_MANY_REQUESTS,
        };
        HttpResponse::build(status).insert_header(retry_after()).body(self.to_string())
    }
}

/// A counter is right even if a thread has panicked that held it.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(address: &str) -> Peer {
        Peer::Client(address.parse().unwrap())
    }

    #[test]
    fn seats_are_counted_in_all_and_per_address() {
        let connections = Connections::new(4, 2);
        let first = connections.admit(client("203.0.113.9")).unwrap();
        let _second = connections.admit(client("203.0.113.9")).unwrap();
        assert_eq!(connections.admit(client("203.0.113.9")).unwrap_err(), Crowded::FromThere);
        let _other = connections.admit(client("203.0.113.10")).unwrap();
        assert_eq!(connections.count(), 3);
        drop(first);
        let _again = connections.admit(client("203.0.113.9")).unwrap();
        let _proxy = connections.admit(Peer::Proxy("127.0.0.1".parse().unwrap())).unwrap();
        assert_eq!(connections.admit(client("203.0.113.11")).unwrap_err(), Crowded::Everywhere);
    }

    #[test]
    fn nothing_is_kept_of_those_who_have_left() {
        let connections = Connections::new(9, 1);
        let connection = connections.admit(client("2001:db8::1")).unwrap();
        assert_eq!(connections.admit(client("2001:db8::2")).unwrap_err(), Crowded::FromThere, "the same household");
        let _neighbour = connections.admit(client("2001:db8:0:1::1")).unwrap();
        assert_eq!(lock(&connections.taken).len(), 2);
        drop(connection);
        assert_eq!(lock(&connections.taken).len(), 1);
    }
}
