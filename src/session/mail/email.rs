//! Composes e-mails: a subject, and plain text from a template.
//!
//! Untrusted text, such as a server's error, becomes one line without control characters, in the text and in headers.

use askama::Template;
use lettre::Message;
use lettre::message::Mailbox;
use lettre::message::header::{ContentType, HeaderName, HeaderValue};

use super::outbox::{MailEntry, NoticeKind};
use super::smtp::MailError;
use crate::session::config::SessionConfig;
use crate::shared::run::timestamp;
use crate::shared::text::excerpt;

/// Longest untrusted text that is shown, in characters.
const MAX_LETTERS: usize = 500;

/// Composes the texts of one session server.
#[derive(Debug, Clone)]
pub struct Composer {
    session_server: String,
    monitor: String,
}

/// Composes the e-mails of one session server.
#[derive(Debug, Clone)]
pub struct EmailComposer {
    from: Mailbox,
    to: Mailbox,
    texts: Composer,
}

#[derive(Template)]
#[template(path = "mail.txt")]
struct Text<'mail> {
    summary: &'mail str,
    lines: Vec<Line>,
    composer: &'mail Composer,
}

/// The lines of an e-mail about one server.
struct Line {
    server: String,
    event: &'static str,
    at: String,
    load: Option<String>,
    error: Option<String>,
    held_back: usize,
}

impl Composer {
    /// Composes texts that tell where they come from.
    pub fn new(config: &SessionConfig) -> Self {
        Self {
            session_server: excerpt(&config.address().to_string(), MAX_LETTERS),
            monitor: format!("{}/monitor", excerpt(&config.http_url(), MAX_LETTERS)),
        }
    }

    /// The subject and the text about these entries.
    ///
    /// # Errors
    /// When the template can't be rendered.
    pub fn compose(&self, entries: &[MailEntry]) -> Result<(String, String), MailError> {
        let events: Vec<NoticeKind> = entries.iter().map(|entry| entry.notice.event).collect();
        let lines: Vec<Line> = entries.iter().map(Line::new).collect();
        let mut subject = summary(&events);
        if let [only] = lines.as_slice() {
            subject = format!("{subject}: {}", only.server);
        }
        self.text(subject, lines)
    }

    /// The subject and the text of `--test-mail`.
    ///
    /// # Errors
    /// When the template can't be rendered.
    pub fn test(&self) -> Result<(String, String), MailError> {
        self.text("Test of the session server's notifications".to_owned(), Vec::new())
    }

    fn text(&self, subject: String, lines: Vec<Line>) -> Result<(String, String), MailError> {
        let text = Text { summary: &subject, lines, composer: self }.render()?;
        Ok((subject, text))
    }
}

impl EmailComposer {
    /// Creates a composer from the configuration.
    ///
    /// # Errors
    /// When it names no administrator or sender.
    pub fn new(config: &SessionConfig) -> Result<Self, MailError> {
        Ok(Self {
            from: config.mail_sender.clone().ok_or(MailError::Off("mailSender"))?,
            to: config.administrator.clone().ok_or(MailError::Off("administrator"))?,
            texts: Composer::new(config),
        })
    }

    /// The address of the administrator.
    pub fn recipient(&self) -> &str {
        self.to.email.as_ref()
    }

    /// The e-mail about these entries.
    ///
    /// # Errors
    /// When it can't be written.
    pub fn compose(&self, entries: &[MailEntry]) -> Result<Message, MailError> {
        self.message(self.texts.compose(entries)?)
    }

    /// The e-mail of `--test-mail`.
    ///
    /// # Errors
    /// When it can't be written.
    pub fn test(&self) -> Result<Message, MailError> {
        self.message(self.texts.test()?)
    }

    fn message(&self, (subject, text): (String, String)) -> Result<Message, MailError> {
        let builder = Message::builder().from(self.from.clone()).to(self.to.clone()).subject(subject).message_id(None);
        let mut message = builder.header(ContentType::TEXT_PLAIN).body(text)?;
        // Automatic responders must not answer (RFC 3834).
        let name = HeaderName::new_from_ascii_str("Auto-Submitted");
        message.headers_mut().insert_raw(HeaderValue::new(name, "auto-generated".to_owned()));
        Ok(message)
    }
}

impl Line {
    fn new(entry: &MailEntry) -> Self {
        let notice = &entry.notice;
        Self {
            server: excerpt(&notice.server, MAX_LETTERS),
            event: notice.event.words(),
            at: timestamp(notice.at),
            load: notice.load.map(|load| format!("{:.1}%", load.percent())),
            error: notice.error.as_deref().map(|error| excerpt(error, MAX_LETTERS)),
            held_back: entry.held_back,
        }
    }
}

/// The subject: `Simulation server not responding`, or `3 simulation servers not responding, 1 working again`.
fn summary(events: &[NoticeKind]) -> String {
    use NoticeKind::{AvailableAgain, LookupFails, LookupWorks, MaximumLoad, NotResponding, WorkingAgain};
    if let [only] = events {
        let [noun, _] = only.nouns();
        let (first, rest) = noun.split_at_checked(1).unwrap_or_default();
        return format!("{}{rest} {}", first.to_uppercase(), only.words());
    }
    let all = [NotResponding, WorkingAgain, MaximumLoad, AvailableAgain, LookupFails, LookupWorks];
    let mut parts: Vec<String> = Vec::new();
    let mut before = None;
    for event in all {
        let nouns = event.nouns();
        let [one, many] = nouns;
        match events.iter().filter(|other| **other == event).count() {
            0 => continue,
            count if before == Some(nouns) => parts.push(format!("{count} {}", event.words())),
            1 => parts.push(format!("1 {one} {}", event.words())),
            count => parts.push(format!("{count} {many} {}", event.words())),
        }
        before = Some(nouns);
    }
    parts.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subjects_count_what_happened() {
        use NoticeKind::{AvailableAgain, LookupFails, LookupWorks, MaximumLoad, NotResponding, WorkingAgain};
        for (events, subject) in [
            (vec![NotResponding], "Simulation server not responding"),
            (vec![WorkingAgain], "Simulation server working again"),
            (vec![MaximumLoad], "Simulation server reached maximum load"),
            (vec![AvailableAgain], "Simulation server available again"),
            (vec![NotResponding; 3], "3 simulation servers not responding"),
            (vec![WorkingAgain, NotResponding], "1 simulation server not responding, 1 working again"),
            (
                vec![MaximumLoad, AvailableAgain, MaximumLoad],
                "2 simulation servers reached maximum load, 1 available again",
            ),
            (vec![LookupFails], "Lookup of simulation servers failing"),
            (
                vec![LookupWorks, NotResponding, LookupFails, LookupFails],
                "1 simulation server not responding, 2 lookups of simulation servers failing, 1 working again",
            ),
        ] {
            assert_eq!(summary(&events), subject);
        }
    }
}
