//! The HTTP client with which this server reaches its simulations, one for each thread, and their address.

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use actix_service::ServiceExt;
use actix_tls::connect::Connector;
use actix_web::http::Uri;

/// Timeout of an answer of a simulation.
pub const ANSWER: Duration = Duration::from_secs(10);

/// Reaches simulations on this machine.
#[derive(Clone)]
pub struct Upstream {
    client: awc::Client,
    address: IpAddr,
}

impl Upstream {
    /// Reaches them at this address.
    #[must_use]
    pub fn new(address: IpAddr) -> Self {
        // Messages are small, and must not wait for the acknowledgement of the one before.
        let tcp = Connector::default().service().map(|connection: actix_tls::connect::Connection<Uri, _>| {
            let socket: &actix_web::rt::net::TcpStream = connection.io_ref();
            if let Err(error) = socket.set_nodelay(true) {
                log::debug!("a stream is not without delay: {error}");
            }
            connection
        });
        let connector = awc::Connector::new().connector(tcp).limit(0);
        // Redirects are not followed, and an answer may take as long as the simulation.
        let client = awc::Client::builder().connector(connector).disable_timeout().disable_redirects();
        Self { client: client.no_default_headers().finish(), address }
    }

    /// The client.
    #[must_use]
    pub fn client(&self) -> &awc::Client {
        &self.client
    }

    /// The URL of a path with its query at the port of a simulation.
    #[must_use]
    pub fn url(&self, port: u16, path: &str, query: Option<&str>) -> String {
        let (mark, query) = query.map_or(("", ""), |query| ("?", query));
        format!("http://{}{path}{mark}{query}", SocketAddr::from((self.address, port)))
    }
}
