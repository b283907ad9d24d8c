//! Notices to the administrator, by mail and by webhook: what is worth one, how it is worded, and how it is sent.

mod email;
mod mailer;
mod outbox;
mod smtp;
mod way;
mod webhook;

pub use mailer::{Mailer, start, test_mail, test_webhook};
pub use outbox::{Notice, NoticeKind, Topic};
pub use smtp::MailError;
pub use way::Way;
