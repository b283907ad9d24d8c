//! Delivers e-mails to the SMTP server with lettre's connection, one step at a time, so that an error names its step.
//!
//! With a password the connection is encrypted before anything else is sent: from the first byte (implicit TLS), or by
//! STARTTLS. Which authorities are trusted is read from the system for each e-mail.

use std::error::Error;
use std::fmt::Display;
use std::net::SocketAddr;
use std::time::Duration;

use lettre::Message;
use lettre::transport::smtp::Error as SmtpError;
use lettre::transport::smtp::authentication::{Credentials, DEFAULT_MECHANISMS};
use lettre::transport::smtp::client::{AsyncSmtpConnection, TlsParameters};
use lettre::transport::smtp::commands::{Data, Mail, Rcpt};
use lettre::transport::smtp::extension::ClientId;
use rustls::pki_types::ServerName;
use tokio::net::{TcpStream, lookup_host};
use tokio::time::{Instant, timeout_at};
use tokio_rustls::TlsConnector;

use super::bounded_stream::BoundedStream;
use super::mail_error::MailError;
use crate::session::config::SessionConfig;
use crate::shared::config::Secret;
use crate::shared::http::tls;
use crate::shared::text::one_line;

/// The port on which connections are usually encrypted from the first byte.
const IMPLICIT_TLS_PORT: u16 = 465;
const DEFAULT_PORT: u16 = 25;
const DEFAULT_PORT_WITH_PASSWORD: u16 = 587;

/// The SMTP server that takes the e-mails.
#[derive(Debug, Clone)]
pub struct Relay {
    host: String,
    port: u16,
    implicit_tls: bool,
    login: Option<(String, Secret)>,
    time_limit: Duration,
}

impl Relay {
    /// The SMTP server of the configuration.
    ///
    /// # Errors
    /// When a key without which no e-mail is sent is not set.
    pub fn new(config: &SessionConfig) -> Result<Self, MailError> {
        if config.administrator.is_none() {
            return Err(MailError::Off("administrator"));
        }
        let sender = config.mail_sender.as_ref().ok_or(MailError::Off("mailSender"))?;
        let host = config.mail_server.clone().ok_or(MailError::Off("mailServer"))?;
        let password = config.mail_sender_password.clone().filter(|password| !password.reveal().is_empty());
        let user = config.mail_sender_user.clone().filter(|user| !user.is_empty());
        let login = password.map(|password| (user.unwrap_or_else(|| sender.email.to_string()), password));
        let default_port = if login.is_some() { DEFAULT_PORT_WITH_PASSWORD } else { DEFAULT_PORT };
        let port = config.mail_server_port.unwrap_or(default_port);
        let implicit_tls = config.mail_server_implicit_tls.unwrap_or(port == IMPLICIT_TLS_PORT);
        Ok(Self { host, port, implicit_tls, login, time_limit: config.timing.mail_answer })
    }

    /// `encrypted` or `not encrypted`.
    #[must_use]
    pub fn privacy(&self) -> &'static str {
        if self.login.is_some() || self.implicit_tls { "encrypted" } else { "not encrypted" }
    }

    /// `HOST:PORT`.
    #[must_use]
    pub fn name(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    /// Delivers an e-mail and returns the SMTP server's answer, within `timing.mailAnswer`.
    ///
    /// # Errors
    /// When the SMTP server does not take it, or does not say so in time.
    pub async fn deliver(&self, message: &Message) -> Result<String, MailError> {
        let deadline = Instant::now() + self.time_limit;
        let late = || self.transient(&format!("no answer within {} s", self.time_limit.as_secs_f64()));
        let mut connection = timeout_at(deadline, self.connect()).await.map_err(|_| late())??;
        let sent = timeout_at(deadline, self.send(&mut connection, message)).await;
        // The SMTP server has the e-mail or not, whatever it answers to QUIT.
        if timeout_at(deadline, connection.abort()).await.is_err() {
            log::debug!("{}: no answer to QUIT", self.name());
        }
        sent.map_err(|_| late())?
    }

    async fn connect(&self) -> Result<AsyncSmtpConnection, MailError> {
        let unresolved = |error| self.transient(&format!("the name can't be resolved: {error}"));
        let unreachable = |error| self.transient(&format!("can't connect: {error}"));
        let addresses = lookup_host((self.host.as_str(), self.port)).await.map_err(unresolved)?;
        let stream = TcpStream::connect(addresses.collect::<Vec<_>>().as_slice()).await.map_err(unreachable)?;
        let peer = stream.peer_addr().map_err(unreachable)?;
        let me = ClientId::default();
        if self.implicit_tls {
            return self.connect_with_tls(stream, peer, &me).await;
        }
        let stream = Box::new(BoundedStream::new(stream, peer));
        let connected = AsyncSmtpConnection::connect_with_transport(stream, &me).await;
        let mut connection = connected.map_err(|error| self.refused("the connection", &error))?;
        if self.login.is_some() {
            if !connection.can_starttls() {
                connection.abort().await;
                let reason = "the server offers no STARTTLS, and a password is never sent over plain text";
                return Err(self.not_encrypted(reason));
            }
            let parameters = self.read_trusted(TlsParameters::new).await?.map_err(|error| self.not_encrypted(error))?;
            let encrypted = connection.starttls(parameters, &me).await;
            encrypted.map_err(|error| match error.status() {
                Some(_) => self.refused("STARTTLS", &error),
                None => self.no_tls(&error),
            })?;
        }
        Ok(connection)
    }

    async fn connect_with_tls(
        &self,
        stream: TcpStream,
        peer: SocketAddr,
        me: &ClientId,
    ) -> Result<AsyncSmtpConnection, MailError> {
        let config = self.read_trusted(|_| tls::client_config()).await?;
        let connector = TlsConnector::from(config.ok_or_else(|| self.not_encrypted("TLS is off"))?);
        let name = ServerName::try_from(self.host.clone()).map_err(|error| self.not_encrypted(error))?;
        let stream = connector.connect(name, stream).await.map_err(|error| self.no_tls(&error))?;
        let stream = Box::new(BoundedStream::new(stream, peer));
        let connected = AsyncSmtpConnection::connect_with_transport(stream, me).await;
        connected.map_err(|error| self.refused("the connection", &error))
    }

    /// Reads the trusted authorities from the disk, in a thread of its own.
    async fn read_trusted<T: Send + 'static>(&self, read: fn(String) -> T) -> Result<T, MailError> {
        let host = self.host.clone();
        actix_rt::task::spawn_blocking(move || read(host)).await.map_err(|error| self.not_encrypted(error))
    }

    async fn send(&self, connection: &mut AsyncSmtpConnection, message: &Message) -> Result<String, MailError> {
        if let Some((user, password)) = &self.login {
            let credentials = Credentials::new(user.clone(), password.reveal().to_owned());
            let login = connection.auth(DEFAULT_MECHANISMS, &credentials).await;
            login.map_err(|error| self.login_failed(user, &error))?;
        }
        let sender = message.envelope().from();
        let sent = connection.command(Mail::new(sender.cloned(), Vec::new())).await;
        sent.map_err(|error| {
            self.refused(sender.map(|sender| format!("the sender {sender}")).unwrap_or_default(), &error)
        })?;
        for recipient in message.envelope().to() {
            let sent = connection.command(Rcpt::new(recipient.clone(), Vec::new())).await;
            sent.map_err(|error| self.refused(format!("the recipient {recipient}"), &error))?;
        }
        connection.command(Data).await.map_err(|error| self.refused("the mail", &error))?;
        let sent = connection.message(&message.formatted()).await;
        let answer = sent.map_err(|error| self.refused("the mail", &error))?;
        Ok(one_line(answer.first_line().unwrap_or_default()))
    }

    fn login_failed(&self, user: &str, error: &SmtpError) -> MailError {
        if error.is_permanent() {
            self.permanent(&format!("wrong user or password, logging in as {user}: {}", answer(error)))
        } else if error.is_client() {
            self.permanent(&format!("refuses any login: {}", root(error)))
        } else {
            self.refused(format!("the login of {user}"), error)
        }
    }

    /// The SMTP server refused a step, or the connection broke in it.
    fn refused(&self, what: impl Display, error: &SmtpError) -> MailError {
        match error.status() {
            Some(_) => self.delivery(&format!("refuses {what}: {}", answer(error)), error.is_permanent()),
            None => self.transient(&format!("the connection broke: {}", root(error))),
        }
    }

    fn no_tls(&self, error: &(dyn Error + 'static)) -> MailError {
        let reason = root(error);
        match tls_error(error) {
            Some(rustls::Error::InvalidCertificate(_)) => self.permanent(&format!(
                "its certificate is not trusted: {reason} (SSL_CERT_FILE may name another authority)"
            )),
            Some(_) => self.not_encrypted(reason),
            None => self.transient(&format!("the connection broke: {reason}")),
        }
    }

    fn not_encrypted(&self, reason: impl Display) -> MailError {
        self.permanent(&format!("no encrypted connection: {reason}"))
    }

    fn permanent(&self, problem: &str) -> MailError {
        self.delivery(problem, true)
    }

    fn transient(&self, problem: &str) -> MailError {
        self.delivery(problem, false)
    }

    fn delivery(&self, problem: &str, permanent: bool) -> MailError {
        MailError::Delivery { server: self.name(), problem: one_line(problem), permanent }
    }
}

/// The SMTP server's answer: its code and its words.
fn answer(error: &SmtpError) -> String {
    let code = error.status().map(|code| format!("{code} ")).unwrap_or_default();
    format!("{code}{}", root(error))
}

/// An error and its causes.
fn chain<'error>(error: &'error (dyn Error + 'static)) -> impl Iterator<Item = &'error (dyn Error + 'static)> {
    std::iter::successors(Some(error), |error| (*error).source())
}

/// The words of the innermost cause.
fn root(error: &(dyn Error + 'static)) -> String {
    chain(error).last().unwrap_or(error).to_string()
}

/// The TLS error among the causes of an error.
fn tls_error<'error>(error: &'error (dyn Error + 'static)) -> Option<&'error rustls::Error> {
    chain(error).find_map(|error| {
        let inside = error.downcast_ref::<std::io::Error>().and_then(std::io::Error::get_ref);
        inside.and_then(|inside| inside.downcast_ref()).or_else(|| error.downcast_ref())
    })
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
