//! Composes e-mails: subject, text and HTML out of two templates, and headers.
//!
//! Text from outside, such as a server's error, never has a line break in a header, and is escaped in the HTML.

use std::time::SystemTime;

use askama::Template;
use lettre::Message;
use lettre::message::header::{Header, HeaderName, HeaderValue};
use lettre::message::{Mailbox, MultiPart};

use super::notices::{Entry, Event};
use crate::session::config::SessionConfig;
use crate::shared::text::excerpt;

/// How many letters of a text from outside are shown.
const MAX_LETTERS: usize = 500;

/// Composes the e-mails of one session server.
#[derive(Debug, Clone)]
pub struct EmailComposer {
    from: Mailbox,
    to: Mailbox,
    session_server: String,
    monitor: String,
}

/// Why an e-mail can't be composed.
#[derive(Debug, thiserror::Error)]
pub enum EmailError {
    /// A template failed.
    #[error("the mail can't be written: {0}")]
    Template(#[from] askama::Error),
    /// A header or an address is wrong.
    #[error("the mail can't be written: {0}")]
    Message(#[from] lettre::error::Error),
}

#[derive(Template)]
#[template(path = "mail.txt")]
struct Text<'mail>(&'mail Content<'mail>);

#[derive(Template)]
#[template(path = "mail.html")]
struct Html<'mail>(&'mail Content<'mail>);

/// What both templates show.
struct Content<'mail> {
    summary: &'mail str,
    lines: Vec<Line>,
    composer: &'mail EmailComposer,
}

/// What an e-mail says about one server.
struct Line {
    server: String,
    event: &'static str,
    at: String,
    load: Option<String>,
    error: Option<String>,
    held_back: usize,
}

impl EmailComposer {
    /// Composes e-mails as the configuration says; nothing if it names no administrator or sender.
    #[must_use]
    pub fn new(config: &SessionConfig) -> Option<Self> {
        Some(Self {
            from: config.mail_sender.clone()?,
            to: config.administrator.clone()?,
            session_server: excerpt(&config.address().to_string(), MAX_LETTERS),
            monitor: format!("{}/monitor", excerpt(&config.http_url(), MAX_LETTERS)),
        })
    }

    /// The address of the administrator.
    #[must_use]
    pub fn recipient(&self) -> &str {
        self.to.email.as_ref()
    }

    /// The e-mail about these entries.
    ///
    /// # Errors
    /// When a template or a header can't be written.
    pub fn compose<'entries>(&self, entries: impl Iterator<Item = &'entries Entry>) -> Result<Message, EmailError> {
        let mut events = Vec::new();
        let lines: Vec<Line> = entries
            .map(|entry| {
                events.push(entry.notice.event);
                Line::new(entry)
            })
            .collect();
        let mut subject = summary(&events);
        if let [only] = lines.as_slice() {
            subject = format!("{subject}: {}", only.server);
        }
        self.message(&subject, lines)
    }

    /// The e-mail of `--test-mail`.
    ///
    /// # Errors
    /// When a template or a header can't be written.
    pub fn test(&self) -> Result<Message, EmailError> {
        self.message("Test of the session server's notifications", Vec::new())
    }

    fn message(&self, subject: &str, lines: Vec<Line>) -> Result<Message, EmailError> {
        let content = Content { summary: subject, lines, composer: self };
        let (text, html) = (Text(&content).render()?, Html(&content).render()?);
        let message = Message::builder()
            .from(self.from.clone())
            .to(self.to.clone())
            .subject(subject)
            .message_id(None)
            .header(AutoSubmitted)
            .multipart(MultiPart::alternative_plain_html(text, html))?;
        Ok(message)
    }
}

impl Line {
    fn new(entry: &Entry) -> Self {
        let notice = &entry.notice;
        Self {
            server: excerpt(&notice.server, MAX_LETTERS),
            event: notice.event.words(),
            at: time(notice.at),
            load: notice.load.map(|load| format!("{:.1}%", load.percent())),
            error: notice.error.as_deref().map(|error| excerpt(error, MAX_LETTERS)),
            held_back: entry.held_back,
        }
    }
}

/// Tells automatic responders not to answer (RFC 3834).
#[derive(Clone)]
struct AutoSubmitted;

impl Header for AutoSubmitted {
    fn name() -> HeaderName {
        HeaderName::new_from_ascii_str("Auto-Submitted")
    }

    fn parse(_: &str) -> Result<Self, Box<dyn std::error::Error + Send + Sync>> {
        Ok(Self)
    }

    fn display(&self) -> HeaderValue {
        HeaderValue::new(Self::name(), "auto-generated".to_owned())
    }
}

/// The subject: `Simulation server not responding`, or `3 simulation servers not responding, 1 working again`.
fn summary(events: &[Event]) -> String {
    use Event::{AvailableAgain, LookupFails, LookupWorks, MaximumLoad, NotResponding, WorkingAgain};
    if let [only] = events {
        let [noun, _] = only.nouns();
        let (first, rest) = noun.split_at_checked(1).unwrap_or_default();
        return format!("{}{rest} {}", first.to_uppercase(), only.words());
    }
    let all = [NotResponding, WorkingAgain, MaximumLoad, AvailableAgain, LookupFails, LookupWorks];
    let counts = all.map(|event| (events.iter().filter(|other| **other == event).count(), event));
    let mut parts: Vec<String> = Vec::new();
    let mut before = None;
    for (count, event) in counts.into_iter().filter(|(count, _)| *count > 0) {
        let nouns = event.nouns();
        let [one, many] = nouns;
        parts.push(match count {
            _ if before == Some(nouns) => format!("{count} {}", event.words()),
            1 => format!("1 {one} {}", event.words()),
            _ => format!("{count} {many} {}", event.words()),
        });
        before = Some(nouns);
    }
    parts.join(", ")
}

/// A time for people, to the second: `2026-03-01 14:05:09 UTC`.
fn time(at: SystemTime) -> String {
    jiff::Timestamp::try_from(at)
        .map_or_else(|_| "unknown".to_owned(), |time| time.strftime("%Y-%m-%d %H:%M:%S UTC").to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subjects_count_what_happened() {
        use Event::{AvailableAgain, LookupFails, LookupWorks, MaximumLoad, NotResponding, WorkingAgain};
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

    #[test]
    fn the_time_is_in_utc() {
        let at = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(1_772_373_909);
        assert_eq!(time(at), "2026-03-01 14:05:09 UTC");
    }
}
