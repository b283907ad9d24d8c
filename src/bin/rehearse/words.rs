//! The results of steps as text that fits into one line. Pure.

use webots_fleet::shared::text;

use crate::connection::Ended;

/// Longest excerpt of a text, in characters.
const EXCERPT: usize = 90;
/// Longest line of a server's text, in characters: a simulation's last output is part of a reason.
const LONGEST_LINE: usize = 2000;
/// Limit of unexpected texts that are listed.
const LONGEST_LIST: usize = 8;

/// The received text, or why there is none.
pub(crate) fn told(came: &Result<String, Ended>) -> String {
    came.as_ref().map_or_else(over, |text| excerpt(text))
}

/// Why a connection can't be used any more, as text.
pub(crate) fn over(ended: &Ended) -> String {
    match ended {
        Ended::Closed(_) | Ended::Broken(_) => format!("the connection was {ended}"),
        Ended::Unreachable(..) | Ended::Refused(..) | Ended::Late(_) => ended.to_string(),
        Ended::Fault(text) => excerpt(text),
    }
}

/// Adds a text to a list that is shown, up to its limit.
pub(crate) fn add(list: &mut Vec<String>, text: &str) {
    match list.len() {
        0..LONGEST_LIST => list.push(excerpt(text)),
        LONGEST_LIST => list.push("and more".to_owned()),
        _ => {}
    }
}

/// The beginning of a text, on one line, as code.
pub(crate) fn excerpt(text: &str) -> String {
    format!("`{}`", text::excerpt(text, EXCERPT).replace('`', "'"))
}

/// A server's text, on one line of limited length.
pub(crate) fn line(text: &str) -> String {
    text::excerpt(text, LONGEST_LINE)
}
