//! The servers below a service manager and with displays, and the files of `deploy/`.

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
mod release;
mod scaling;
