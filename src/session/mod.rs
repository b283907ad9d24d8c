//! The session server: the one door to a fleet of simulation servers.

pub mod config;
pub mod letter;
pub mod mail_address;
pub mod mailer;
pub mod notices;
pub mod outbox;
pub mod smtp;
pub mod placement;
