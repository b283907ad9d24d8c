//! `simulations.csv`: a line for each simulation that has ended (RFC 4180).

use std::io::{self, Write};
use std::path::Path;
use std::time::{Duration, SystemTime};

use super::ended::Ended;
use crate::shared::run::{RotatedFile, timestamp};
use crate::shared::text::one_line;

/// The first line.
const HEADING: &str = "id,begin,end,client,repository,world,port,level,peak memory (bytes),processor time (s),reason,user,label (unverified),waited (s)\n";
/// Size from which the file is rotated, in bytes.
const MAX_SIZE: u64 = 2_500_000;

/// Appends a line to the file at this path.
///
/// # Errors
/// When it can't be written.
pub(super) fn append(path: &Path, level: &str, ended: &Ended) -> io::Result<()> {
    RotatedFile::open(path, MAX_SIZE, HEADING)?.write_all(line(level, ended).as_bytes())
}

fn line(level: &str, ended: &Ended) -> String {
    let time = |seconds| timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds));
    let simulation = &ended.simulation;
    let taken = ended.end.taken;
    let fields = [
        simulation.id.to_string(),
        time(simulation.since),
        time(ended.at),
        quoted(&ended.client.map(|client| client.to_string()).unwrap_or_default()),
        quoted(&simulation.repository),
        quoted(&simulation.world),
        simulation.port.map(|port| port.to_string()).unwrap_or_default(),
        level.to_owned(),
        taken.memory.map(|bytes| bytes.to_string()).unwrap_or_default(),
        taken
            .time
            .map(|time| format!("{:.1}", time.as_secs_f64()))
            .unwrap_or_default(),
        ended.end.failure.reason.code().to_owned(),
        quoted(simulation.identity.user.as_deref().unwrap_or_default()),
        quoted(simulation.identity.label.as_deref().unwrap_or_default()),
        simulation
            .waited
            .map(|waited| format!("{waited:.1}"))
            .unwrap_or_default(),
    ];
    fields.join(",") + "\n"
}

/// A text that others choose, in quotes. An apostrophe is put before what a spreadsheet would read as a formula: at the
/// beginning, and after a character at which a spreadsheet may begin the next cell.
fn quoted(text: &str) -> String {
    let mut quoted = String::from('"');
    let mut begins = true;
    for letter in one_line(text).chars() {
        if begins && matches!(letter, '=' | '+' | '-' | '@') {
            quoted.push('\'');
        }
        if letter == '"' {
            quoted.push('"');
        }
        quoted.push(letter);
        begins = matches!(letter, ',' | ';' | '|') || begins && matches!(letter, ' ' | '"');
    }
    quoted.push('"');
    quoted
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_stays_one_field_and_is_no_formula() {
        for (text, written) in [
            ("192.0.2.7", "\"192.0.2.7\""),
            ("a,b", "\"a,b\""),
            ("say \"hi\"", "\"say \"\"hi\"\"\""),
            ("one\r\ntwo", "\"one  two\""),
            ("=HYPERLINK(\"x\",1)", "\"'=HYPERLINK(\"\"x\"\",1)\""),
            ("+1", "\"'+1\""),
            ("-1", "\"'-1\""),
            ("@SUM(1)", "\"'@SUM(1)\""),
            ("\t=1", "\" '=1\""),
            ("a;=1", "\"a;'=1\""),
            ("a; \"+1\"", "\"a; \"\"'+1\"\"\""),
            ("a,-1", "\"a,'-1\""),
            ("1-1=0", "\"1-1=0\""),
            ("", "\"\""),
        ] {
            assert_eq!(quoted(text), written, "{text:?}");
        }
    }
}
