//! Delivers e-mails to the administrator with lettre's transport.
//!
//! With a password the connection is encrypted before the login: from the first byte (implicit TLS), or by STARTTLS.
//! The trusted authorities are read from the system for each e-mail, so that a renewed file needs no restart.

use std::error::Error;
use std::time::Duration;

use lettre::message::Mailbox;
use lettre::message::header::{ContentType, HeaderName, HeaderValue};
use lettre::transport::smtp::Error as SmtpError;
use lettre::transport::smtp::authentication::Credentials;
use lettre::transport::smtp::client::{Tls, TlsParameters};
use lettre::{AsyncSmtpTransport, AsyncTransport, Message, Tokio1Executor};
use tokio::time::timeout;

use super::notice_text::NoticeText;
use crate::session::config::SessionConfig;
use crate::shared::config::Secret;
use crate::shared::text::one_line;

/// The usual port of implicit TLS.
const IMPLICIT_TLS_PORT: u16 = 465;
const DEFAULT_PORT: u16 = 25;
const DEFAULT_PORT_WITH_PASSWORD: u16 = 587;

/// Why an e-mail was not sent, in one line.
#[derive(Debug, thiserror::Error)]
pub enum MailError {
    /// This key is required for e-mails and not set.
    #[error("notifications are off: {0} is not set")]
    Off(&'static str),
    /// The text can't be rendered.
    #[error("the mail can't be written: {0}")]
    Template(#[from] askama::Error),
    /// A header or an address is wrong.
    #[error("the mail can't be written: {0}")]
    Message(#[from] lettre::error::Error),
    /// The SMTP server did not take it.
    #[error("{server}: {problem}")]
    Delivery {
        /// `HOST:PORT` of the SMTP server.
        server: String,
        /// The reason, as text of the SMTP server or of the system.
        problem: String,
        /// Whether the configuration or the SMTP server must change before another try can succeed (RFC 5321, 4.2.1).
        permanent: bool,
    },
}

impl MailError {
    /// Whether the configuration or the SMTP server must change before another try can succeed.
    pub fn is_permanent(&self) -> bool {
        !matches!(self, Self::Delivery { permanent: false, .. })
    }
}

/// The SMTP server that takes the e-mails, and their addresses.
#[derive(Debug, Clone)]
pub struct SmtpRelay {
    from: Mailbox,
    to: Mailbox,
    host: String,
    port: u16,
    /// `HOST:PORT`.
    server: String,
    implicit_tls: bool,
    login: Option<Credentials>,
    time_limit: Duration,
}

impl SmtpRelay {
    /// The SMTP server of the configuration.
    ///
    /// # Errors
    /// When a key that is required for e-mails is not set.
    pub fn new(config: &SessionConfig) -> Result<Self, MailError> {
        let from = config.mail_sender.clone().ok_or(MailError::Off("mailSender"))?;
        let host = config.mail_server.clone().ok_or(MailError::Off("mailServer"))?;
        let to = config.administrator.clone().ok_or(MailError::Off("administrator"))?;
        let password = config.mail_sender_password.as_ref().map(Secret::reveal).filter(|text| !text.is_empty());
        let user = config.mail_sender_user.clone().filter(|user| !user.is_empty());
        let user = user.unwrap_or_else(|| from.email.to_string());
        let login = password.map(|password| Credentials::new(user, password.to_owned()));
        let default_port = if login.is_some() { DEFAULT_PORT_WITH_PASSWORD } else { DEFAULT_PORT };
        let port = config.mail_server_port.unwrap_or(default_port);
        let implicit_tls = config.mail_server_implicit_tls.unwrap_or(port == IMPLICIT_TLS_PORT);
        let (server, time_limit) = (format!("{host}:{port}"), config.timing.mail_answer);
        Ok(Self { from, to, host, port, server, implicit_tls, login, time_limit })
    }

    /// `HOST:PORT`.
    pub fn server(&self) -> &str {
        &self.server
    }

    /// Who gets the e-mails from where, for the administrator.
    pub fn description(&self) -> String {
        let privacy = if self.is_encrypted() { "encrypted" } else { "not encrypted" };
        format!("{} ({privacy}) took a mail for {}", self.server, self.to.email)
    }

    fn is_encrypted(&self) -> bool {
        self.login.is_some() || self.implicit_tls
    }

    /// Delivers an e-mail within `timing.mailAnswer`. Returns the SMTP server's answer.
    ///
    /// # Errors
    /// When the SMTP server does not take it, or does not say so in time.
    pub async fn deliver(&self, text: NoticeText) -> Result<String, MailError> {
        let message = self.message(text)?;
        // lettre's timeout covers connecting only. Its pool would reuse a connection after a timeout for the next
        // e-mail.
        let delivered = timeout(self.time_limit, async { self.transport()?.send(message).await }).await;
        match delivered {
            Ok(Ok(answer)) => Ok(one_line(answer.first_line().unwrap_or_default())),
            Ok(Err(error)) => Err(self.failure(&error)),
            Err(_) => Err(self.delivery(&format!("no answer within {} s", self.time_limit.as_secs_f64()), false)),
        }
    }

    fn message(&self, NoticeText { subject, body }: NoticeText) -> Result<Message, MailError> {
        let builder = Message::builder().from(self.from.clone()).to(self.to.clone()).subject(subject).message_id(None);
        let mut message = builder.header(ContentType::TEXT_PLAIN).body(body)?;
        // Automatic responders must not answer (RFC 3834).
        let name = HeaderName::new_from_ascii_str("Auto-Submitted");
        message.headers_mut().insert_raw(HeaderValue::new(name, "auto-generated".to_owned()));
        Ok(message)
    }

    fn transport(&self) -> Result<AsyncSmtpTransport<Tokio1Executor>, SmtpError> {
        let mut builder = AsyncSmtpTransport::<Tokio1Executor>::builder_dangerous(self.host.as_str()).port(self.port);
        if self.is_encrypted() {
            let parameters = TlsParameters::new(self.host.clone())?;
            builder = builder.tls(if self.implicit_tls { Tls::Wrapper(parameters) } else { Tls::Required(parameters) });
        }
        if let Some(login) = &self.login {
            builder = builder.credentials(login.clone());
        }
        Ok(builder.build())
    }

    fn failure(&self, error: &SmtpError) -> MailError {
        let reason = root(error);
        if let Some(code) = error.status() {
            self.delivery(&format!("{code} {reason}"), error.is_permanent())
        } else if reason.starts_with("invalid peer certificate") {
            let advice = "SSL_CERT_FILE may name another authority";
            self.delivery(&format!("its certificate is not trusted: {reason} ({advice})"), true)
        } else {
            self.delivery(&reason, error.is_client())
        }
    }

    fn delivery(&self, problem: &str, permanent: bool) -> MailError {
        MailError::Delivery { server: self.server.clone(), problem: one_line(problem), permanent }
    }
}

/// The text of the innermost cause.
fn root(error: &(dyn Error + 'static)) -> String {
    std::iter::successors(Some(error), |error| (*error).source()).last().unwrap_or(error).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_and_encryption_follow_from_the_password() {
        for (keys, port, implicit_tls, is_encrypted) in [
            (r#""mailSenderUser": "fleet""#, 25, false, false),
            (r#""mailSenderPassword": """#, 25, false, false),
            (r#""mailSenderPassword": "x""#, 587, false, true),
            (r#""mailSenderPassword": "x", "mailServerPort": 25"#, 25, false, true),
            (r#""mailSenderPassword": "x", "mailServerPort": 465"#, 465, true, true),
            (r#""mailServerPort": 465"#, 465, true, true),
            (r#""mailServerPort": 2465, "mailServerImplicitTls": true"#, 2465, true, true),
        ] {
            let json = format!(
                r#"{{"port": 1999, "simulationServers": [], "administrator": "a@example.org", "mailServer": "smtp",
                     "mailSender": "b@example.org", {keys}}}"#
            );
            let relay = SmtpRelay::new(&serde_json::from_str(&json).unwrap()).unwrap();
            assert_eq!(
                (relay.port, relay.implicit_tls, relay.is_encrypted()),
                (port, implicit_tls, is_encrypted),
                "{keys}"
            );
        }
    }
}
