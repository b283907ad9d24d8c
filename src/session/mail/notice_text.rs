//! Composes the text of notices: a subject, and plain text from a template.
//!
//! Untrusted text, such as a server's error, becomes one line without control characters, in the text and in headers.

use askama::Template;

use super::outbox::{MailEntry, NoticeKind};
use crate::session::config::SessionConfig;
use crate::shared::run::timestamp;
use crate::shared::text::excerpt;

/// Longest untrusted text that is shown, in characters.
const MAX_LETTERS: usize = 500;

/// A text about notices, for all channels.
#[derive(Debug)]
pub struct NoticeText {
    /// The subject of a mail.
    pub subject: String,
    /// The text, of several lines.
    pub body: String,
}

/// Composes the texts of one session server.
#[derive(Debug)]
pub struct Composer {
    session_server: String,
    monitor: String,
}

#[derive(Template)]
#[template(path = "mail.txt")]
struct Text<'mail> {
    summary: &'mail str,
    lines: Vec<Line>,
    composer: &'mail Composer,
}

/// The lines of a text about one server.
struct Line {
    server: String,
    event: &'static str,
    at: String,
    load: Option<String>,
    error: Option<String>,
    held_back: usize,
}

impl Composer {
    /// Composes texts that name this session server.
    pub fn new(config: &SessionConfig) -> Self {
        Self {
            session_server: excerpt(&config.address().to_string(), MAX_LETTERS),
            monitor: format!("{}/monitor", excerpt(&config.http_url(), MAX_LETTERS)),
        }
    }

    /// The text about these entries.
    ///
    /// # Errors
    /// When the template can't be rendered.
    pub fn compose(&self, entries: &[MailEntry]) -> askama::Result<NoticeText> {
        let events: Vec<NoticeKind> = entries.iter().map(|entry| entry.notice.event).collect();
        let lines: Vec<Line> = entries.iter().map(Line::new).collect();
        let mut subject = summary(&events);
        if let [only] = lines.as_slice() {
            subject = format!("{subject}: {}", only.server);
        }
        self.text(subject, lines)
    }

    /// The text of `--test-mail`.
    ///
    /// # Errors
    /// When the template can't be rendered.
    pub fn test(&self) -> askama::Result<NoticeText> {
        self.text("Test of the session server's notifications".to_owned(), Vec::new())
    }

    fn text(&self, subject: String, lines: Vec<Line>) -> askama::Result<NoticeText> {
        let body = Text { summary: &subject, lines, composer: self }.render()?;
        Ok(NoticeText { subject, body })
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
