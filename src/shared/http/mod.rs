//! What the HTTP interfaces of both servers share: pages, live updates, WebSockets, limits, certificates, metrics.

mod address_quota;
pub mod assets;
mod auth;
pub mod body;
mod client_stream;
mod connections;
mod live_updates;
pub mod liveness;
mod metrics;
mod origin;
mod page;
mod peer;
pub mod routing;
pub mod server;
pub mod tls;
pub mod websocket;

pub use address_quota::{AddressQuota, share};
pub use auth::{AuthError, BasicAuth, refuse_action, require_administrator};
pub use client_stream::upgrade;
pub use connections::{ConnectionKind, ConnectionLimiter, ConnectionPermit, STREAMS_PER_CLIENT, TCP_PER_CLIENT};
pub use live_updates::{LiveUpdates, PageView, TableRow};
pub use metrics::{CONTENT_TYPE, Gauge, Metrics};
pub use origin::Origin;
pub use page::{OWN_FILES, VIEWER, any_host, fleet_sources, foreign_scripts, heat, html, width};
pub use peer::{Peer, TrustedProxies, UserHeader};
