//! Composes the text of notices: a subject, and plain text.
//!
//! Untrusted text, such as a server's error, becomes one line without control characters, in the text and in headers.

use super::outbox::{Notice, NoticeKind, WaitingNotice};
use crate::session::config::SessionConfig;
use crate::shared::text::excerpt;

/// Longest untrusted text that is shown, in characters.
const MAX_LETTERS: usize = 500;

/// The last lines of each text: the URL of the monitor, and the session server that sends the text.
pub fn signature(config: &SessionConfig) -> String {
    format!(
        "Monitor: {}/monitor\nSent by the session server {}\n",
        config.http_url(),
        config.address()
    )
}

/// The text about these notices. Its first line is the subject of a mail.
pub fn notice_text(entries: &[WaitingNotice], signature: &str) -> String {
    let paragraphs: String = entries.iter().map(|entry| paragraph(&entry.notice)).collect();
    format!("{}\n\n{paragraphs}{signature}", summary(entries))
}

/// The text of `--test-mail`.
pub fn test_text(signature: &str) -> String {
    let words = "Nothing has happened: notices about simulation servers will arrive like this one.";
    format!("Test of the session server's notifications\n\n{words}\n\n{signature}")
}

fn paragraph(notice: &Notice) -> String {
    let server = excerpt(&notice.server, MAX_LETTERS);
    let event = notice.event.words();
    let load = notice
        .load
        .map(|load| format!("  Load:       {:.1}%\n", load.percent()))
        .unwrap_or_default();
    let places = notice
        .places
        .map(|(clients, places)| format!("  Clients:    {clients} in {places} places\n"))
        .unwrap_or_default();
    let error = notice.failure.as_ref().map(|failure| {
        let text = excerpt(&failure.in_full(), MAX_LETTERS);
        format!("  Last error: {text}\n  Reason:     {}\n", failure.reason)
    });
    format!(
        "{server}: {event}\n  Time:       {}\n{load}{places}{}\n",
        notice.at,
        error.unwrap_or_default()
    )
}

/// The subject: `Simulation server not responding: HOST:PORT`, or `Simulation servers: 3 not responding, 1 working again`.
pub fn summary(entries: &[WaitingNotice]) -> String {
    use NoticeKind::{AvailableAgain, MaximumLoad, NotResponding, WorkingAgain};
    if let [WaitingNotice { notice, .. }] = entries {
        return format!(
            "Simulation server {}: {}",
            notice.event.words(),
            excerpt(&notice.server, MAX_LETTERS)
        );
    }
    let counts = [NotResponding, WorkingAgain, MaximumLoad, AvailableAgain].map(|event| {
        let count = entries.iter().filter(|entry| entry.notice.event == event).count();
        (count > 0).then(|| format!("{count} {}", event.words()))
    });
    format!(
        "Simulation servers: {}",
        counts.into_iter().flatten().collect::<Vec<_>>().join(", ")
    )
}
