//! The session server: the one door to a fleet of simulation servers.

pub mod app;
pub mod asking;
pub mod audience;
pub mod changes;
pub mod config;
pub mod fleet_status;
pub mod letter;
pub mod mail_address;
pub mod mailer;
pub mod names;
pub mod notices;
pub mod outbox;
pub mod page_routes;
pub mod pages;
pub mod pick;
pub mod placement;
pub mod registry;
pub mod routes;
pub mod server;
pub mod server_monitor;
pub mod smtp;
pub mod status;
pub mod subscribers;
pub mod unreachable;
pub mod watched;
pub mod web_client;
