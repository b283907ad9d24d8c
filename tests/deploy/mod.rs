//! What a service manager, an administrator and a display see of the servers.

mod containers;
mod display;
mod files;
mod kubernetes;
mod listening;
mod notify;
mod packet_filter;
mod ports;
mod preflight;
mod prometheus;
mod scaling;
