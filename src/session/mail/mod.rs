//! Mail to the administrator: what is worth an e-mail, how it is worded, and how it is sent.

mod email;
mod mailer;
mod outbox;
mod smtp;

pub use mailer::{Mailer, start, test_mail};
pub use outbox::{Event, Notice, Topic};
pub use smtp::MailError;
