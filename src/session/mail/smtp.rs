//! Delivers e-mails to the administrator with lettre's SMTP client, one connection for each.
//!
//! With a password the connection is encrypted before the login: from the first byte (implicit TLS), or by STARTTLS.
//! The trusted authorities are read from the system for each e-mail, so that a renewed file needs no restart.

use std::error::Error;
use std::io;

use lettre::Message;
use lettre::message::Mailbox;
use lettre::message::header::{ContentType, HeaderName, HeaderValue};
use lettre::transport::smtp::Error as SmtpError;
use lettre::transport::smtp::authentication::{Credentials, DEFAULT_MECHANISMS};
use lettre::transport::smtp::client::{AsyncSmtpConnection, TlsParameters};
use lettre::transport::smtp::extension::ClientId;
use rustls::Error as TlsError;
use rustls::pki_types::ServerName;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use super::limited_stream::LimitedStream;
use crate::session::config::SessionConfig;
use crate::shared::config::Secret;
use crate::shared::http::tls;

/// Why an e-mail was not sent.
type Problem = Box<dyn Error + Send + Sync>;

/// The usual port of implicit TLS.
const IMPLICIT_TLS_PORT: u16 = 465;

/// The SMTP server that takes the e-mails, and their addresses.
#[derive(Debug, Clone)]
pub(super) struct SmtpRelay {
    from: Mailbox,
    to: Mailbox,
    host: String,
    port: u16,
    implicit_tls: bool,
    login: Option<Credentials>,
}

impl SmtpRelay {
    /// The SMTP server of the configuration.
    ///
    /// # Errors
    /// The first key that e-mails require and that is not set.
    pub(super) fn new(config: &SessionConfig) -> Result<Self, &'static str> {
        let from = config.mail_sender.clone().ok_or("mailSender")?;
        let host = config.mail_server.clone().ok_or("mailServer")?;
        let to = config.administrator.clone().ok_or("administrator")?;
        let password = config
            .mail_sender_password
            .as_ref()
            .map(Secret::reveal)
            .filter(|text| !text.is_empty());
        let user = config.mail_sender_user.clone().filter(|user| !user.is_empty());
        let user = user.unwrap_or_else(|| from.email.to_string());
        let login = password.map(|password| Credentials::new(user, password.to_owned()));
        let port = config
            .mail_server_port
            .unwrap_or(if login.is_some() { 587 } else { 25 });
        let implicit_tls = config.mail_server_implicit_tls.unwrap_or(port == IMPLICIT_TLS_PORT);
        Ok(Self {
            from,
            to,
            host,
            port,
            implicit_tls,
            login,
        })
    }

    /// `HOST:PORT`.
    pub(super) fn server(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    /// Delivers a text, whose first line is the subject of the e-mail. Returns the SMTP server's answer.
    ///
    /// # Errors
    /// When the SMTP server does not take it.
    pub(super) async fn deliver(&self, text: &str) -> Result<String, String> {
        let subject = text.lines().next().unwrap_or_default();
        let message = Message::builder()
            .from(self.from.clone())
            .to(self.to.clone())
            .subject(subject)
            .message_id(None);
        let mut message = message
            .header(ContentType::TEXT_PLAIN)
            .body(text.to_owned())
            .map_err(|error| error.to_string())?;
        // Automatic responders must not answer (RFC 3834).
        let name = HeaderName::new_from_ascii_str("Auto-Submitted");
        message
            .headers_mut()
            .insert_raw(HeaderValue::new(name, "auto-generated".to_owned()));
        // The caller sets the timeout.
        self.send(&message).await.map_err(|problem| reason(&*problem))
    }

    async fn send(&self, message: &Message) -> Result<String, Problem> {
        let mut server = self.connect().await?;
        let answer = server.send(message.envelope(), &message.formatted()).await?;
        server.abort().await;
        Ok(answer.first_line().unwrap_or_default().to_owned())
    }

    /// Connects, encrypts, and logs in, as the configuration says.
    async fn connect(&self) -> Result<AsyncSmtpConnection, Problem> {
        let stream = TcpStream::connect((self.host.as_str(), self.port)).await?;
        let peer = stream.peer_addr()?;
        let own_name = ClientId::default();
        let mut server = if self.implicit_tls {
            let config = tls::client_config().ok_or("TLS can't be set up")?;
            let name = ServerName::try_from(self.host.clone())?;
            let stream = TlsConnector::from(config).connect(name, stream).await?;
            let stream = Box::new(LimitedStream::new(stream, peer));
            AsyncSmtpConnection::connect_with_transport(stream, &own_name).await?
        } else {
            let stream = Box::new(LimitedStream::new(stream, peer));
            AsyncSmtpConnection::connect_with_transport(stream, &own_name).await?
        };
        if let Some(login) = &self.login {
            if !self.implicit_tls {
                server
                    .starttls(TlsParameters::new(self.host.clone())?, &own_name)
                    .await?;
            }
            server.auth(DEFAULT_MECHANISMS, login).await?;
        }
        Ok(server)
    }
}

/// Why an e-mail was not sent: the SMTP server's answer, or the innermost cause.
fn reason(problem: &(dyn Error + 'static)) -> String {
    let causes = || std::iter::successors(Some(problem), |problem| (*problem).source());
    let cause = causes().last().map(ToString::to_string).unwrap_or_default();
    match (
        problem.downcast_ref().and_then(SmtpError::status),
        causes().find_map(tls_error),
    ) {
        (Some(code), _) => format!("{code} {cause}"),
        (None, Some(error @ TlsError::InvalidCertificate(_))) => {
            format!("{} (SSL_CERT_FILE may name another authority)", tls::in_words(error))
        }
        (None, _) => cause,
    }
}

/// The error of TLS that this is, or that it contains.
fn tls_error<'error>(problem: &'error (dyn Error + 'static)) -> Option<&'error TlsError> {
    let of_io = || problem.downcast_ref::<io::Error>()?.get_ref()?.downcast_ref();
    problem.downcast_ref().or_else(of_io)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_and_encryption_follow_from_the_password() {
        for (keys, port, implicit_tls) in [
            (r#""mailSenderUser": "fleet""#, 25, false),
            (r#""mailSenderPassword": """#, 25, false),
            (r#""mailSenderPassword": "x""#, 587, false),
            (r#""mailSenderPassword": "x", "mailServerPort": 25"#, 25, false),
            (r#""mailSenderPassword": "x", "mailServerPort": 465"#, 465, true),
            (r#""mailServerPort": 465"#, 465, true),
            (r#""mailServerPort": 2465, "mailServerImplicitTls": true"#, 2465, true),
        ] {
            let json = format!(
                r#"{{"administrator": "a@example.org", "mailServer": "smtp", "mailSender": "b@example.org", {keys}}}"#
            );
            let relay = SmtpRelay::new(&serde_json::from_str(&json).unwrap()).unwrap();
            assert_eq!((relay.port, relay.implicit_tls), (port, implicit_tls), "{keys}");
        }
    }
}
