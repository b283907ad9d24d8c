//! Notices to the administrator, by mail and by webhook: what is worth one, how it is worded, and how it is sent.

mod channel;
mod mailer;
mod notice_text;
mod outbox;
mod smtp;

pub use channel::Channel;
pub use mailer::start;
pub use outbox::{Notice, NoticeKind};
