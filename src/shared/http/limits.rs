//! Limits of connections, in total and per client address, and rate limits per address, so that one client can't use up
//! everything.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::hash::Hash;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix_web::HttpResponse;
use actix_web::http::StatusCode;
use parking_lot::Mutex;

use super::peer::Peer;
use super::routing::retry_after;

/// What is counted. Each kind has its own limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ConnectionKind {
    /// A TCP connection, with any content.
    Tcp,
    /// The WebSocket of a web client.
    Client,
    /// A page that listens to `/events`.
    Page,
    /// The WebSocket of a session server.
    Link,
    /// What is relayed from a simulation: its stream, or a file.
    Stream,
}

/// Fewest TCP connections per web client for which the limits leave room: browsers open several.
pub const TCP_PER_CLIENT: usize = 2;
/// Limit of concurrent relayed streams and files per web client: one stream and six files of a scene, because browsers
/// load six at a time.
pub const STREAMS_PER_CLIENT: usize = 7;
/// Default limit of web clients per address.
const MAX_CLIENTS_PER_ADDRESS: usize = 1000;
/// Limit of pages that listen to `/events`, and of session servers: anybody may connect as one, and prove nothing.
const MAX_PAGES: usize = 1000;

/// Default limit for one address, out of `all` slots or connections: three quarters. A class often shares one address,
/// but a single client must not take everything.
pub fn share(all: usize) -> usize {
    all - all / 4
}

/// Counts the open connections of a server. Clones share their counts.
#[derive(Debug, Clone)]
pub struct ConnectionLimiter {
    max_tcp: usize,
    max_clients: usize,
    /// Limit of web clients per address.
    per_address: usize,
    open: Counts,
}

/// What a count of open connections covers: one address, or (`None`) all of a kind.
type Key = (ConnectionKind, Option<IpAddr>);
/// Numbers of open connections.
type Counts = Arc<Mutex<HashMap<Key, usize>>>;

/// One connection that is counted until this is dropped.
#[derive(Debug)]
pub struct ConnectionPermit {
    kind: ConnectionKind,
    address: Option<IpAddr>,
    open: Counts,
}

/// Why a connection is refused, as text for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ConnectionLimitError {
    /// The server has too many.
    #[error("Error: too many connections.")]
    InAll,
    /// The client's address has too many.
    #[error("Error: too many connections from your address.")]
    FromAddress,
}

impl ConnectionLimiter {
    /// Allows `max_tcp` TCP connections and `max_clients` web clients, of which one address may have `per_address`;
    /// `None` is [`share`] of them, but at most [`MAX_CLIENTS_PER_ADDRESS`].
    pub fn new(max_tcp: usize, max_clients: usize, per_address: Option<usize>) -> Self {
        let per_address = per_address.unwrap_or_else(|| share(max_clients).min(MAX_CLIENTS_PER_ADDRESS));
        Self {
            max_tcp,
            max_clients,
            per_address,
            open: Arc::default(),
        }
    }

    /// Number of open connections of a kind.
    pub fn count(&self, kind: ConnectionKind) -> usize {
        self.open.lock().get(&(kind, None)).copied().unwrap_or_default()
    }

    /// Counts a connection. A proxy that does not report its clients' addresses stands for many clients, so only the
    /// total limits apply to it.
    ///
    /// # Errors
    /// When the server or the address has too many connections of this kind.
    pub fn admit(&self, kind: ConnectionKind, peer: Peer) -> Result<ConnectionPermit, ConnectionLimitError> {
        let (max, max_per_address) = match kind {
            ConnectionKind::Tcp => {
                let per_client = (self.max_tcp / self.max_clients.max(1)).max(TCP_PER_CLIENT);
                let wanted = self.per_address.saturating_mul(per_client);
                (self.max_tcp, wanted.min(share(self.max_tcp)).max(self.per_address))
            }
            ConnectionKind::Client => (self.max_clients, self.per_address),
            ConnectionKind::Stream => (
                self.max_clients.saturating_mul(STREAMS_PER_CLIENT),
                self.per_address.saturating_mul(STREAMS_PER_CLIENT),
            ),
            ConnectionKind::Page | ConnectionKind::Link => (MAX_PAGES, self.per_address.min(share(MAX_PAGES))),
        };
        let address = peer.rate_limit_key();
        let mut open = self.open.lock();
        let count = |key| open.get(&key).copied().unwrap_or_default();
        if count((kind, None)) >= max {
            return Err(ConnectionLimitError::InAll);
        }
        if address.is_some() && count((kind, address)) >= max_per_address {
            return Err(ConnectionLimitError::FromAddress);
        }
        for key in keys(kind, address) {
            *open.entry(key).or_default() += 1;
        }
        drop(open);
        Ok(ConnectionPermit {
            kind,
            address,
            open: Arc::clone(&self.open),
        })
    }
}

/// The keys of the counts to which a connection contributes.
fn keys(kind: ConnectionKind, address: Option<IpAddr>) -> impl Iterator<Item = Key> {
    [Some((kind, None)), address.map(|address| (kind, Some(address)))]
        .into_iter()
        .flatten()
}

impl Drop for ConnectionPermit {
    fn drop(&mut self) {
        let mut open = self.open.lock();
        for key in keys(self.kind, self.address) {
            if let Entry::Occupied(mut count) = open.entry(key) {
                *count.get_mut() -= 1;
                if *count.get() == 0 {
                    count.remove();
                }
            }
        }
    }
}

impl actix_web::ResponseError for ConnectionLimitError {
    fn error_response(&self) -> HttpResponse {
        let status = match self {
            Self::InAll => StatusCode::SERVICE_UNAVAILABLE,
            Self::FromAddress => StatusCode::TOO_MANY_REQUESTS,
        };
        HttpResponse::build(status)
            .insert_header(retry_after())
            .body(self.to_string())
    }
}

/// Largest number of keys that are tracked.
const MAX_KEYS: usize = 10_000;

/// Rate limit per client address.
pub type AddressQuota = Quota<IpAddr>;

/// Rate limit per key.
#[derive(Debug)]
pub struct Quota<Key> {
    /// The time in which one use becomes available again.
    interval: Duration,
    /// The time in which a whole quota becomes available again.
    whole: Duration,
    /// When the whole quota of a key is available again (GCRA: its theoretical arrival time). Other keys have used
    /// nothing.
    restored: Mutex<HashMap<Key, Instant>>,
}

impl<Key: Copy + Eq + Hash> Quota<Key> {
    /// An unused quota: `burst` uses at once, and `per_minute` uses in each minute after that.
    pub fn new(burst: u32, per_minute: u32) -> Self {
        let interval = Duration::from_mins(1) / per_minute.max(1);
        Self {
            interval,
            whole: interval * burst,
            restored: Mutex::default(),
        }
    }

    /// Takes one use from the quota of a key, such as an address. Returns whether there was one left; always true if the
    /// key is unknown.
    pub fn take(&self, key: Option<Key>) -> bool {
        let Some(key) = key else { return true };
        let now = Instant::now();
        let mut restored = self.restored.lock();
        if restored.len() >= MAX_KEYS && !restored.contains_key(&key) {
            make_room(&mut restored, now);
        }
        let at = restored.entry(key).or_insert(now);
        let next = now.max(*at) + self.interval;
        let is_left = next <= now + self.whole;
        if is_left {
            *at = next;
        }
        is_left
    }

    /// Gives back one use that was taken.
    pub fn give_back(&self, key: Option<Key>) {
        if let Some(key) = key
            && let Some(at) = self.restored.lock().get_mut(&key)
            && let Some(earlier) = at.checked_sub(self.interval)
        {
            *at = earlier;
        }
    }
}

/// Forgets the keys whose whole quota is available again; if many remain, also the half that has used the least. So
/// clients with very many addresses can neither fill the memory nor have others refused.
fn make_room<Key: Eq + Hash>(restored: &mut HashMap<Key, Instant>, now: Instant) {
    restored.retain(|_, at| *at > now);
    if restored.len() > MAX_KEYS / 2 {
        let mut times: Vec<Instant> = restored.values().copied().collect();
        let (_, &mut middle, _) = times.select_nth_unstable(MAX_KEYS / 2);
        restored.retain(|_, at| *at > middle);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(address: &str) -> Peer {
        Peer::Client(address.parse().unwrap())
    }

    #[test]
    fn one_address_leaves_something_to_others() {
        for (tcp, clients) in [(2000, 1000), (21_000, 20_000), (16, 15), (4000, 1000)] {
            let connections = ConnectionLimiter::new(tcp, clients, None);
            for (kind, all) in [
                (ConnectionKind::Tcp, tcp),
                (ConnectionKind::Client, clients),
                (ConnectionKind::Page, MAX_PAGES),
                (ConnectionKind::Link, MAX_PAGES),
            ] {
                let one: Vec<_> = std::iter::repeat_with(|| connections.admit(kind, client("203.0.113.9")))
                    .take(all)
                    .collect();
                let had = one.iter().filter(|one| one.is_ok()).count();
                assert!(had <= share(all) && had > 0, "{kind:?}: {had} of {all}");
                connections.admit(kind, client("203.0.113.10")).unwrap();
            }
        }
    }

    #[test]
    fn nothing_is_kept_of_those_who_have_left() {
        let connections = ConnectionLimiter::new(9, 9, Some(1));
        let admit = |address| connections.admit(ConnectionKind::Client, client(address));
        let permit = admit("2001:db8::1").unwrap();
        assert_eq!(
            admit("2001:db8::2").unwrap_err(),
            ConnectionLimitError::FromAddress,
            "the same /64"
        );
        let _neighbour = admit("2001:db8:0:1::1").unwrap();
        assert_eq!(connections.open.lock().len(), 3);
        drop(permit);
        assert_eq!(connections.open.lock().len(), 2);
        assert_eq!(connections.count(ConnectionKind::Client), 1);
    }

    #[test]
    fn a_quota_is_used_up_and_comes_back() {
        let address = Some("203.0.113.9".parse().unwrap());
        let quota = AddressQuota::new(3, 6000);
        assert_eq!([(); 4].map(|()| quota.take(address)), [true, true, true, false]);
        quota.give_back(address);
        assert_eq!([(); 2].map(|()| quota.take(address)), [true, false]);
        assert!(quota.take(Some("203.0.113.10".parse().unwrap())), "another address");
        assert!(quota.take(None));
        let deadline = Instant::now() + Duration::from_secs(20);
        while !quota.take(address) {
            assert!(Instant::now() < deadline);
            std::thread::yield_now();
        }
    }

    #[test]
    fn many_addresses_fill_no_memory_and_keep_nobody_out() {
        let quota = AddressQuota::new(30, 12);
        let guesser = Some("2001:db8::".parse().unwrap());
        while quota.take(guesser) {}
        for number in 0..50_000_u128 {
            let other = std::net::Ipv6Addr::from_bits((0x2001_0db9 << 96) + (number << 64));
            assert!(quota.take(Some(other.into())), "{other}");
        }
        assert!(quota.restored.lock().len() <= MAX_KEYS);
        assert!(!quota.take(guesser), "the one who has used most is not forgotten");
    }
}
