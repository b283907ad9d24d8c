//! The channels on which notices go: by mail, and to a messenger.

use std::fmt;

use super::notice_text::NoticeText;
use super::smtp::{MailError, SmtpRelay};
use super::webhook::Webhook;
use crate::session::config::SessionConfig;

/// A channel for notices. Each has its own retries: one that does not work holds up no other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Channel {
    /// To the administrator's mail address.
    Mail,
    /// To the URL of the key `webhook`.
    Webhook,
}

impl Channel {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Mail, Self::Webhook];
}

impl fmt::Display for Channel {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Mail => "mail",
            Self::Webhook => "webhook",
        })
    }
}

/// What delivers the notices of a channel.
#[derive(Clone)]
pub(super) enum Transport {
    Smtp(Box<SmtpRelay>),
    Webhook(Webhook),
}

impl Transport {
    /// The transport of a channel.
    ///
    /// # Errors
    /// When a key without which nothing is sent on this channel is not set.
    pub(super) fn new(config: &SessionConfig, channel: Channel) -> Result<Self, MailError> {
        match channel {
            Channel::Mail => SmtpRelay::new(config).map(|relay| Self::Smtp(Box::new(relay))),
            Channel::Webhook => Webhook::new(config).map(Self::Webhook),
        }
    }

    /// `HOST:PORT` of the server that it delivers to.
    pub(super) fn server(&self) -> &str {
        match self {
            Self::Smtp(relay) => relay.server(),
            Self::Webhook(webhook) => webhook.server(),
        }
    }

    /// Delivers a text. Returns the server's answer.
    ///
    /// # Errors
    /// When it is not taken.
    pub(super) async fn deliver(&self, text: NoticeText) -> Result<String, MailError> {
        match self {
            Self::Smtp(relay) => relay.deliver(text).await,
            Self::Webhook(webhook) => webhook.deliver(&text.body).await,
        }
    }
}
