//! Mail to the administrator: what is worth an e-mail, how it is worded, and how it is sent.

mod bounded_stream;
mod email;
mod mail_error;
mod mailer;
mod notices;
mod outbox;
mod smtp;

pub use mail_error::MailError;
pub use mailer::{Mailer, start, test_mail};
pub use notices::{Event, Notice, Topic};
