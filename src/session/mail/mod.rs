//! Mail to the administrator: what is worth one, how it is worded, and how it is sent.

mod email;
pub mod mailer;
mod notices;
mod outbox;
mod smtp;

pub use notices::{Event, Notice, Topic};
