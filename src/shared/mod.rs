//! What both servers stand on. Knows neither of them.

pub mod address;
pub mod admission;
pub mod assets;
pub mod auth;
pub mod config;
pub mod config_error;
pub mod config_value;
pub mod connections;
pub mod live;
pub mod liveness;
pub mod load;
pub mod logging;
pub mod metrics;
pub mod notify;
pub mod origin;
pub mod page;
pub mod paths;
pub mod peer;
pub mod permanent;
pub mod project_url;
pub mod repositories;

pub mod rotated_file;
pub mod shutdown;
pub mod sockets;
pub mod start;
pub mod status;
pub mod timestamp;
pub mod tls;
pub mod websocket;
