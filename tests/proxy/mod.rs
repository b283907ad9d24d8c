//! The fleet behind real web servers: Debian's apache2 and nginx, started here on free ports of the loopback, with our
//! rules (`deploy/`) and with those of the original documents.

mod browser;
mod fleet;
mod rules;
mod web_server;

mod addresses;
mod connections;
mod encoded;
mod exposure;
mod one_door;
mod pages;
mod relayed;
mod trust;
mod urls;
mod visitor;
mod whole_way;
