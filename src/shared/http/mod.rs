//! What the web sides of both servers use: pages, live updates, WebSockets, limits, certificates, metrics.

mod address_quota;
pub mod assets;
mod auth;
pub mod body;
mod client_stream;
mod connections;
mod live;
pub mod liveness;
mod metrics;
mod origin;
mod page;
pub mod paths;
mod peer;
pub mod server;
pub mod tls;
pub mod websocket;

pub use address_quota::{AddressQuota, share};
pub use auth::{AuthError, BasicAuth, is_administrator, refuse_action};
pub use connections::{ConnectionPermit, Connections, Kind};
pub use live::{Live, Row, View};
pub use metrics::{CONTENT_TYPE, Gauge, Metrics};
pub use origin::Origin;
pub use page::{Policy, any_host, fleet_sources, heat, html, own_sources, width};
pub use peer::{Peer, TrustedProxies, UserHeader};
