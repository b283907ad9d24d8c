//! Whether another program has a port.

use std::io::{self, ErrorKind};
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};

use socket2::{Domain, Socket, Type};

/// Whether no program listens at a port, on any address of this machine.
///
/// Binds the port as Webots does, but does not listen: a process that another thread is just starting may inherit the
/// socket for a moment, and one that does not listen disturbs no program that binds the port with `SO_REUSEADDR`.
pub fn is_free(port: u16) -> bool {
    let addresses = [
        (Ipv4Addr::UNSPECIFIED, port).into(),
        (Ipv6Addr::UNSPECIFIED, port).into(),
    ];
    // A machine may have only one of IPv4 and IPv6.
    let is_taken = |error: io::Error| error.kind() == ErrorKind::AddrInUse;
    !addresses.into_iter().any(|address| bind(address).is_err_and(is_taken))
}

fn bind(address: SocketAddr) -> io::Result<()> {
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, None)?;
    socket.set_reuse_address(true)?;
    socket.bind(&address.into())
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn a_port_is_taken_while_a_program_listens_at_one_address() {
        for address in ["127.0.0.1:0", "[::1]:0"] {
            let Ok(listener) = TcpListener::bind(address) else {
                continue;
            };
            let port = listener.local_addr().unwrap().port();
            assert!(!is_free(port), "{address}");
            drop(listener);
            assert!(is_free(port), "{address}");
        }
    }

    #[test]
    fn a_socket_that_is_bound_by_the_check_keeps_no_other_from_the_port() {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let address = (Ipv4Addr::UNSPECIFIED, port).into();
        let inherited = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
        inherited.set_reuse_address(true).unwrap();
        inherited.bind(&SocketAddr::into(address)).unwrap();
        assert!(is_free(port));
        assert!(TcpListener::bind(address).is_ok());
    }
}
