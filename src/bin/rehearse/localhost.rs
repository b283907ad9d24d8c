//! Whether a fleet is on this machine.

use std::net::{SocketAddr, TcpListener, ToSocketAddrs};

use url::Url;

/// Whether all addresses of a URL's host belong to this machine; false if the name can't be resolved.
pub(crate) fn is_localhost(url: &Url) -> bool {
    let Some(host) = url.host_str() else {
        return false;
    };
    let host = host.trim_matches(['[', ']']);
    let Ok(addresses) = (host, 0).to_socket_addrs() else {
        return false;
    };
    let mut addresses = addresses.peekable();
    addresses.peek().is_some() && addresses.all(is_own)
}

/// Only an address of this machine can be bound. The loopback always is one, also if IPv6 is off and /etc/hosts still
/// has `::1`.
fn is_own(address: SocketAddr) -> bool {
    address.ip().to_canonical().is_loopback() || TcpListener::bind(address).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_own_addresses_are_this_machine() {
        let is_here = |url: &str| is_localhost(&Url::parse(url).unwrap());
        assert!(is_here("http://127.0.0.1:1999") && is_here("http://localhost:1999"));
        // Also on a machine without IPv6.
        assert!(is_here("http://[::1]:1999") && is_here("http://[::ffff:127.0.0.1]:1999"));
        assert!(!is_here("http://192.0.2.1:1999") && !is_here("http://fleet.invalid"));
    }
}
