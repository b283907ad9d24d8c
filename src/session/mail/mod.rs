//! Notices to the administrator, by mail and by webhook: their kinds, text, batches and delivery.

mod channel;
mod limited_stream;
mod mailer;
mod notice_text;
mod outbox;
mod smtp;

pub use channel::Channel;
pub use mailer::start;
pub use outbox::{Notice, NoticeKind};
