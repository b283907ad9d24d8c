//! `simulations.csv`: a line for each simulation that has ended (RFC 4180).

use std::io::{self, Write};
use std::path::Path;
use std::time::{Duration, SystemTime};

use super::ended::Ended;
use crate::shared::run::{RotatedFile, timestamp};
use crate::shared::text::one_line;

/// The first line.
const HEADING: &str = "id,begin,end,client,repository,world,port,level,peak memory (bytes),processor time (s),reason,user,label (unverified)\n";
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
    let (simulation, taken) = (&ended.simulation, ended.how.taken);
    let fields = [
        simulation.id.to_string(),
        time(simulation.since),
        time(ended.at),
        ended.client.to_string(),
        simulation.repository.clone(),
        simulation.world.clone(),
        simulation.port.map(|port| port.to_string()).unwrap_or_default(),
        level.to_owned(),
        taken.memory.map(|bytes| bytes.to_string()).unwrap_or_default(),
        taken
            .time
            .map(|time| format!("{:.1}", time.as_secs_f64()))
            .unwrap_or_default(),
        ended.how.reason.label().to_owned(),
        simulation.identity.user.clone().unwrap_or_default(),
        simulation.identity.label.clone().unwrap_or_default(),
    ];
    fields.map(|text| field(&text)).join(",") + "\n"
}

/// A quoted field. An apostrophe is prepended if a spreadsheet would read the text as a formula.
fn field(text: &str) -> String {
    let formula = text.starts_with(['=', '+', '-', '@', '\t', '\r', '\n']);
    let text = if formula {
        format!("'{}", one_line(text))
    } else {
        one_line(text)
    };
    if text.contains([',', '"']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_stays_one_field_and_is_no_formula() {
        for (text, written) in [
            ("192.0.2.7", "192.0.2.7"),
            ("2001:db8::7", "2001:db8::7"),
            ("a,b", "\"a,b\""),
            ("say \"hi\"", "\"say \"\"hi\"\"\""),
            ("one\r\ntwo", "one  two"),
            ("=HYPERLINK(\"x\",1)", "\"'=HYPERLINK(\"\"x\"\",1)\""),
            ("+1", "'+1"),
            ("-1", "'-1"),
            ("@SUM(1)", "'@SUM(1)"),
            ("\t=1", "' =1"),
            ("", ""),
        ] {
            assert_eq!(field(text), written, "{text:?}");
        }
    }
}
