//! The ways on which notices go: by mail, and to a messenger.

use std::fmt;

use super::email::EmailComposer;
use super::outbox::MailEntry;
use super::smtp::{MailError, Relay};
use super::webhook::Webhook;
use crate::session::config::SessionConfig;

/// A way on which notices go. Each has its own retries: one that does not work holds up no other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Way {
    /// To the administrator's mail address.
    Mail,
    /// To the URL of the key `webhook`.
    Webhook,
}

/// What carries the notices of a way.
#[derive(Clone)]
pub(super) enum Carrier {
    Mail(Relay, Box<EmailComposer>),
    Webhook(Webhook),
}

impl Way {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Mail, Self::Webhook];
}

impl fmt::Display for Way {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::Mail => "mail",
            Self::Webhook => "webhook",
        })
    }
}

impl Carrier {
    /// The carrier of a way.
    ///
    /// # Errors
    /// When a key without which nothing is sent on this way is not set.
    pub(super) fn new(config: &SessionConfig, way: Way) -> Result<Self, MailError> {
        match way {
            Way::Mail => Ok(Self::Mail(Relay::new(config)?, Box::new(EmailComposer::new(config)?))),
            Way::Webhook => Webhook::new(config).map(Self::Webhook),
        }
    }

    /// Where it carries them, without what is secret.
    pub(super) fn name(&self) -> String {
        match self {
            Self::Mail(relay, _) => relay.name(),
            Self::Webhook(webhook) => webhook.name().to_owned(),
        }
    }

    /// Carries these entries. Returns what was answered.
    ///
    /// # Errors
    /// When they were not taken.
    pub(super) async fn carry(&self, entries: &[MailEntry]) -> Result<String, MailError> {
        match self {
            Self::Mail(relay, composer) => relay.deliver(composer.compose(entries)?).await,
            Self::Webhook(webhook) => webhook.deliver(entries).await,
        }
    }
}
