//! Hands mails to the SMTP server, and says in plain words why one did not get there.
//!
//! With a password the connection is encrypted before anything else: from its first byte where the server does so, else
//! by STARTTLS. Who is trusted is read from the system for each mail, or from the file that `SSL_CERT_FILE` names.

use std::error::Error as _;
use std::time::Duration;

use lettre::transport::smtp::authentication::{Credentials, DEFAULT_MECHANISMS};
use lettre::transport::smtp::client::{AsyncSmtpConnection, TlsParameters};
use lettre::transport::smtp::commands::{Data, Mail, Rcpt};
use lettre::transport::smtp::extension::ClientId;
use tokio::time::{Instant, timeout_at};

use super::email::{Letter, Unwritable};
use crate::session::config::SessionConfig;
use crate::shared::config::Secret;
use crate::shared::run::one_line;

/// The port whose connections are usually encrypted from their first byte.
const IMPLICIT_TLS_PORT: u16 = 465;
const DEFAULT_PORT: u16 = 25;
const DEFAULT_PORT_WITH_PASSWORD: u16 = 587;

/// Why a mail did not get to the SMTP server. Each is one line that names the server.
#[derive(Debug, thiserror::Error)]
pub enum MailError {
    /// A key without which no mail is sent is not set.
    #[error("notifications are off: {0} is not set")]
    Off(&'static str),
    /// The mail can't be made.
    #[error(transparent)]
    Unwritable(#[from] Unwritable),
    /// The SMTP server's name has no address.
    #[error("{server}: the name can't be resolved: {reason}")]
    Unresolved {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// What the system says.
        reason: String,
    },
    /// No connection comes about.
    #[error("{server}: can't connect: {reason}")]
    Unreachable {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// What the system says.
        reason: String,
    },
    /// The SMTP server's certificate is not to be trusted.
    #[error("{server}: its certificate is not trusted: {reason} (SSL_CERT_FILE may name another authority)")]
    Untrusted {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// What is wrong with the certificate.
        reason: String,
    },
    /// The connection can't be encrypted.
    #[error("{server}: no encrypted connection: {reason}")]
    Unencrypted {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// What is missing.
        reason: String,
    },
    /// The SMTP server doesn't know or like the user or the password.
    #[error("{server}: wrong user or password, logging in as {user}: {reason}")]
    Login {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// The user name.
        user: String,
        /// The SMTP server's words.
        reason: String,
    },
    /// The SMTP server says no.
    #[error("{server}: refuses {what}: {reason}")]
    Refused {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// The connection, the login, the sender, the recipient, or the mail.
        what: String,
        /// The SMTP server's words.
        reason: String,
        /// Whether the SMTP server says so for good.
        lasting: bool,
    },
    /// The connection broke.
    #[error("{server}: the connection broke: {reason}")]
    Broken {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// What was noticed.
        reason: String,
    },
    /// The SMTP server is silent.
    #[error("{server}: no answer within {} s", patience.as_secs_f64())]
    Silent {
        /// HOST:PORT of the SMTP server.
        server: String,
        /// How long it was waited for.
        patience: Duration,
    },
}

impl MailError {
    /// Whether somebody has to do something before the next try can do better.
    #[must_use]
    pub fn is_lasting(&self) -> bool {
        match self {
            Self::Unresolved { .. } | Self::Unreachable { .. } | Self::Broken { .. } | Self::Silent { .. } => false,
            Self::Refused { lasting, .. } => *lasting,
            _ => true,
        }
    }
}

/// The SMTP server, and how it is talked to.
#[derive(Debug, Clone)]
pub struct Relay {
    host: String,
    port: u16,
    implicit_tls: bool,
    login: Option<(String, Secret)>,
    patience: Duration,
}

impl Relay {
    /// What the configuration says.
    ///
    /// # Errors
    /// When a key without which no mail is sent is not set.
    pub fn new(config: &SessionConfig) -> Result<Self, MailError> {
        if config.administrator.is_none() {
            return Err(MailError::Off("administrator"));
        }
        let sender = config.mail_sender.as_ref().ok_or(MailError::Off("mailSender"))?;
        let host = config.mail_server.clone().ok_or(MailError::Off("mailServer"))?;
        let login =
            config.mail_sender_password.clone().filter(|password| !password.reveal().is_empty()).map(|password| {
                let user = config.mail_sender_user.clone().filter(|user| !user.is_empty());
                let user = user.unwrap_or_else(|| sender.bare().to_owned());
                (user, password)
            });
        let usual = if login.is_some() { DEFAULT_PORT_WITH_PASSWORD } else { DEFAULT_PORT };
        let port = config.mail_server_port.unwrap_or(usual);
        let implicit_tls = config.mail_server_implicit_tls.unwrap_or(port == IMPLICIT_TLS_PORT);
        Ok(Self { host, port, implicit_tls, login, patience: config.timing.mail_answer })
    }

    /// How the connection is, in a word: `encrypted` or `not encrypted`.
    #[must_use]
    pub fn privacy(&self) -> &'static str {
        if self.login.is_some() || self.implicit_tls { "encrypted" } else { "not encrypted" }
    }

    /// `HOST:PORT`.
    #[must_use]
    pub fn name(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    /// Hands over a mail, and gives back what the SMTP server said. Takes `timing.mailAnswer` at most.
    ///
    /// # Errors
    /// When the SMTP server did not take it, or did not say so in time.
    pub async fn deliver(&self, letter: &Letter) -> Result<String, MailError> {
        let deadline = Instant::now() + self.patience;
        let silent = || MailError::Silent { server: self.name(), patience: self.patience };
        let mut line = timeout_at(deadline, self.connect()).await.map_err(|_| silent())??;
        let handed_over = timeout_at(deadline, self.hand_over(&mut line, letter)).await;
        // What is said to say good-bye can't change whether the mail was taken.
        if timeout_at(deadline, line.abort()).await.is_err() {
            log::debug!("{}: closed without a good-bye", self.name());
        }
        handed_over.map_err(|_| silent())?
    }

    async fn connect(&self) -> Result<AsyncSmtpConnection, MailError> {
        let addresses: Vec<_> = tokio::net::lookup_host((self.host.as_str(), self.port))
            .await
            .map_err(|error| MailError::Unresolved { server: self.name(), reason: one_line(&error.to_string()) })?
            .collect();
        let me = ClientId::default();
        let implicit = if self.implicit_tls { Some(self.trust().await?) } else { None };
        let mut line = AsyncSmtpConnection::connect_tokio1(addresses.as_slice(), None, &me, implicit, None)
            .await
            .map_err(|error| self.no_connection(&error))?;
        if self.login.is_some() && !line.is_encrypted() {
            if !line.can_starttls() {
                line.abort().await;
                let reason = "the server offers no STARTTLS, and a password is never sent over plain text".to_owned();
                return Err(MailError::Unencrypted { server: self.name(), reason });
            }
            let trust = self.trust().await?;
            line.starttls(trust, &me).await.map_err(|error| self.no_connection(&error))?;
        }
        Ok(line)
    }

    /// Whom to trust. Read from the disk, and so in a thread of its own.
    async fn trust(&self) -> Result<TlsParameters, MailError> {
        let host = self.host.clone();
        let unencrypted = |reason| MailError::Unencrypted { server: self.name(), reason };
        match actix_rt::task::spawn_blocking(|| TlsParameters::new(host)).await {
            Ok(Ok(trust)) => Ok(trust),
            Ok(Err(error)) => Err(unencrypted(error.to_string())),
            Err(error) => Err(unencrypted(error.to_string())),
        }
    }

    async fn hand_over(&self, line: &mut AsyncSmtpConnection, letter: &Letter) -> Result<String, MailError> {
        if let Some((user, password)) = &self.login {
            let credentials = Credentials::new(user.clone(), password.reveal().to_owned());
            line.auth(DEFAULT_MECHANISMS, &credentials).await.map_err(|error| self.no_login(user, &error))?;
        }
        let (from, to) = (&letter.from.mailbox().email, &letter.to.mailbox().email);
        let no = |error: &lettre::transport::smtp::Error, what: String| self.refused(what, error);
        let mail = Mail::new(Some(from.clone()), Vec::new());
        line.command(mail).await.map_err(|error| no(&error, format!("the sender {from}")))?;
        let recipient = Rcpt::new(to.clone(), Vec::new());
        line.command(recipient).await.map_err(|error| no(&error, format!("the recipient {to}")))?;
        line.command(Data).await.map_err(|error| no(&error, "the mail".to_owned()))?;
        let answer = line.message(&letter.bytes).await.map_err(|error| no(&error, "the mail".to_owned()))?;
        Ok(one_line(answer.first_line().unwrap_or_default()))
    }

    fn no_connection(&self, error: &lettre::transport::smtp::Error) -> MailError {
        let server = self.name();
        let reason = root(error);
        match tls_fault(error) {
            Some(rustls::Error::InvalidCertificate(_)) => MailError::Untrusted { server, reason },
            Some(_) => MailError::Unencrypted { server, reason },
            None if error.status().is_some() => self.refused("the connection".to_owned(), error),
            None if error.is_response() => MailError::Broken { server, reason },
            None => MailError::Unreachable { server, reason },
        }
    }

    fn no_login(&self, user: &str, error: &lettre::transport::smtp::Error) -> MailError {
        let server = self.name();
        if error.is_permanent() {
            MailError::Login { server, user: user.to_owned(), reason: answer(error) }
        } else if error.is_client() {
            MailError::Refused { server, what: "any login".to_owned(), reason: root(error), lasting: true }
        } else {
            self.refused(format!("the login of {user}"), error)
        }
    }

    fn refused(&self, what: String, error: &lettre::transport::smtp::Error) -> MailError {
        let server = self.name();
        if error.status().is_some() {
            MailError::Refused { server, what, reason: answer(error), lasting: error.is_permanent() }
        } else {
            MailError::Broken { server, reason: root(error) }
        }
    }
}

/// What the SMTP server answered: its code and its words.
fn answer(error: &lettre::transport::smtp::Error) -> String {
    let code = error.status().map(|code| format!("{code} ")).unwrap_or_default();
    format!("{code}{}", root(error))
}

/// The innermost cause, in one line.
fn root(error: &lettre::transport::smtp::Error) -> String {
    let mut cause: &dyn std::error::Error = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    one_line(&cause.to_string())
}

/// The TLS fault behind an error.
fn tls_fault(error: &lettre::transport::smtp::Error) -> Option<&rustls::Error> {
    let mut cause = error.source();
    while let Some(error) = cause {
        let inside = error.downcast_ref::<std::io::Error>().and_then(std::io::Error::get_ref);
        let fault = inside.and_then(|inside| inside.downcast_ref()).or_else(|| error.downcast_ref());
        if fault.is_some() {
            return fault;
        }
        cause = error.source();
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_and_encryption_follow_from_the_password() {
        for (keys, port, implicit_tls, privacy) in [
            (r#""mailSenderUser": "fleet""#, 25, false, "not encrypted"),
            (r#""mailSenderPassword": """#, 25, false, "not encrypted"),
            (r#""mailSenderPassword": "x""#, 587, false, "encrypted"),
            (r#""mailSenderPassword": "x", "mailServerPort": 25"#, 25, false, "encrypted"),
            (r#""mailSenderPassword": "x", "mailServerPort": 465"#, 465, true, "encrypted"),
            (r#""mailServerPort": 465"#, 465, true, "encrypted"),
            (r#""mailServerPort": 2465, "mailServerImplicitTls": true"#, 2465, true, "encrypted"),
        ] {
            let json = format!(
                r#"{{"port": 1999, "simulationServers": [], "administrator": "a@example.org", "mailServer": "smtp",
                     "mailSender": "b@example.org", {keys}}}"#
            );
            let relay = Relay::new(&serde_json::from_str(&json).unwrap()).unwrap();
            assert_eq!((relay.port, relay.implicit_tls, relay.privacy()), (port, implicit_tls, privacy), "{keys}");
        }
    }
}
