//! What the HTTP interfaces of both servers share: pages, live updates, WebSockets, limits, certificates, metrics.

pub mod assets;
mod auth;
mod client_stream;
mod cookie;
mod guesses;
mod limits;
mod live_updates;
pub mod liveness;
mod metrics;
pub mod openapi;
mod origin;
mod page;
mod passing;
mod peer;
pub mod routing;
pub mod server;
pub mod sign_in;
pub mod time_span;
pub mod tls;
pub mod websocket;

pub use auth::{AdminAuth, Administrator, AuthError, AuthSettings};
pub use client_stream::upgrade;
pub use limits::{
    AddressQuota, ConnectionKind, ConnectionLimiter, ConnectionPermit, STREAMS_PER_CLIENT, TCP_PER_CLIENT, share,
};
pub use live_updates::{LiveUpdates, PageView, TableRow};
pub use metrics::{CONTENT_TYPE, Gauge, Metrics};
pub use origin::Origin;
pub use page::{FOREIGN_SCRIPTS, OWN_FILES, SharedPage, VIEWER, framed_by, heat, html, width};
pub use passing::{Owner, Router, open_door};
pub use peer::{Peer, TrustedProxies};
