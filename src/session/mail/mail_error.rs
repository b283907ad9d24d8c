//! Why an e-mail was not sent.

use super::email::EmailError;

/// Why an e-mail was not sent, in one line.
#[derive(Debug, thiserror::Error)]
pub enum MailError {
    /// A key without which no e-mail is sent is not set.
    #[error("notifications are off: {0} is not set")]
    Off(&'static str),
    /// The e-mail can't be composed.
    #[error(transparent)]
    Email(#[from] EmailError),
    /// A step of the delivery failed.
    #[error("{server}: {problem}")]
    Delivery {
        /// `HOST:PORT` of the SMTP server.
        server: String,
        /// The step, and the reason in the words of the SMTP server or of the system.
        problem: String,
        /// Whether somebody has to change something before another try can succeed.
        permanent: bool,
    },
}

impl MailError {
    /// Whether somebody has to change something before another try can succeed.
    #[must_use]
    pub fn is_permanent(&self) -> bool {
        !matches!(self, Self::Delivery { permanent: false, .. })
    }
}
