//! `simulations.csv`: a line for each simulation that has ended (RFC 4180). When a month is over, the file becomes
//! `simulations-YEAR-MONTH.csv`.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Write};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::ended::Ended;
use crate::shared::run::timestamp;
use crate::shared::text::one_line;

/// The first line.
pub const HEADING: &str = "id,begin,end,client,repository,world,port,level,peak memory (bytes),processor time (s),reason,user,label (unverified),waited (s),duration (s),real time (%),below 0.9 of real time (% of the time)\n";
/// The file of this month.
const FILE: &str = "simulations.csv";
/// Length of a month in the name of a file, and in a time: `2026-11`.
const MONTH: usize = 7;

/// Appends a line to the file in the directory `logs`.
///
/// # Errors
/// When it can't be written.
pub(super) fn append(logs: &Path, level: &str, ended: &Ended) -> io::Result<()> {
    fs::create_dir_all(logs)?;
    let path = logs.join(FILE);
    put_aside(logs, &month(SystemTime::now()))?;
    let mut file = File::options().create(true).append(true).open(path)?;
    let heading = if file.metadata()?.len() == 0 { HEADING } else { "" };
    // One write, so that a full disk leaves no part of a line.
    let before = file.metadata()?.len();
    let text = format!("{heading}{}", line(level, ended));
    file.write_all(text.as_bytes()).or_else(|error| {
        file.set_len(before)?;
        Err(error)
    })
}

/// Gives the file the name of its month, if that is over or the file has other columns.
fn put_aside(logs: &Path, now: &str) -> io::Result<()> {
    let path = logs.join(FILE);
    let Ok(about) = fs::metadata(&path) else {
        return Ok(());
    };
    let of_file = month(about.modified()?);
    if about.len() == 0 || (of_file == now && first_line(&path)? == HEADING) {
        return Ok(());
    }
    let names = (0..).map(|number: u32| match number {
        0 => format!("simulations-{of_file}.csv"),
        more => format!("simulations-{of_file}-{more}.csv"),
    });
    let free = names.map(|name| logs.join(name)).find(|path| !path.exists());
    free.map_or(Ok(()), |free| fs::rename(path, free))
}

fn first_line(path: &Path) -> io::Result<String> {
    let mut line = String::new();
    BufReader::new(File::open(path)?).read_line(&mut line)?;
    Ok(line)
}

fn month(time: SystemTime) -> String {
    let mut text = timestamp(time);
    text.truncate(MONTH);
    text
}

/// Removes the files of months that ended more than this many months ago.
pub(super) fn prune(logs: &Path, months: u32) {
    let oldest = month(SystemTime::now() - Duration::from_hours(24 * 31) * months);
    for (of_file, path) in older(logs) {
        if of_file < oldest
            && let Err(error) = fs::remove_file(&path)
        {
            log::warn!("{} can't be removed: {error}", path.display());
        }
    }
}

/// The files of earlier months, each with its month.
fn older(logs: &Path) -> Vec<(String, PathBuf)> {
    let entries = fs::read_dir(logs).into_iter().flatten().flatten();
    let dated = entries.filter_map(|entry| {
        let name = entry.file_name().into_string().ok()?;
        let rest = name.strip_prefix("simulations-")?.strip_suffix(".csv")?;
        let month = rest.get(..MONTH)?;
        let is_month = month.bytes().all(|letter| letter.is_ascii_digit() || letter == b'-');
        is_month.then(|| (month.to_owned(), entry.path()))
    });
    let mut dated: Vec<_> = dated.collect();
    dated.sort();
    dated
}

/// The lines of simulations that were requested before the end of a span of time and have ended after its begin, each with
/// a line end, in the order of the files. Times are as in the file.
pub fn lines(logs: &Path, span: &RangeInclusive<String>) -> Vec<String> {
    let (first, last) = (span.start(), span.end());
    let begins = first.get(..MONTH).unwrap_or_default().to_owned();
    let files = older(logs).into_iter().filter(|(month, _)| *month >= begins);
    let files = files.map(|(_, path)| path).chain([logs.join(FILE)]);
    let mut found = Vec::new();
    for path in files {
        let Ok(text) = fs::read_to_string(&path) else { continue };
        // Files of earlier versions have other columns.
        let Some(lines) = text.strip_prefix(HEADING) else {
            continue;
        };
        let is_in = |line: &&str| {
            let mut fields = line.split(',').skip(1);
            let (begin, end) = (fields.next().unwrap_or_default(), fields.next().unwrap_or_default());
            begin <= last.as_str() && end >= first.as_str()
        };
        found.extend(lines.split_inclusive('\n').filter(is_in).map(str::to_owned));
    }
    found
}

fn line(level: &str, ended: &Ended) -> String {
    let time = |seconds| timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds));
    let simulation = &ended.simulation;
    let taken = ended.end.taken;
    let ran = simulation.launched.map(|launched| ended.at.saturating_sub(launched));
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
        ran.map(|seconds| seconds.to_string()).unwrap_or_default(),
        percent(simulation.time.mean()),
        percent(simulation.time.slow_share()),
    ];
    fields.join(",") + "\n"
}

fn percent(share: Option<f64>) -> String {
    share.map(|share| format!("{:.0}", 100.0 * share)).unwrap_or_default()
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
    use crate::shared::domain::{Failure, ProjectUrl, Reason};
    use crate::shared::http::Peer;
    use crate::simulation::client_identity::ClientIdentity;
    use crate::simulation::simulation_id::SimulationId;
    use crate::simulation::snapshot::Simulation;

    fn ended() -> Ended {
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/arm.wbt").unwrap();
        let simulation = Simulation::new(SimulationId::next(), &world, ClientIdentity::default());
        Ended {
            at: simulation.since + 90,
            simulation,
            client: Some(Peer::Proxy(std::net::Ipv4Addr::LOCALHOST.into())),
            events: Vec::new(),
            end: Failure::new(Reason::Left, "").into(),
        }
    }

    #[test]
    fn a_month_has_a_file_of_its_own_and_none_is_lost_for_a_year() {
        let folder = tempfile::tempdir().unwrap();
        let logs = folder.path();
        let names = || {
            let names = fs::read_dir(logs)
                .unwrap()
                .map(|entry| entry.unwrap().file_name().into_string().unwrap());
            let mut names: Vec<String> = names.collect();
            names.sort();
            names
        };
        let days = |days: u64| Duration::from_hours(24 * days);
        let mut expected = Vec::new();
        // Months of the past, the oldest first.
        for ago in (1..=14).rev() {
            append(logs, "none", &ended()).unwrap();
            let then = SystemTime::now() - days(31 * ago);
            File::options()
                .append(true)
                .open(logs.join(FILE))
                .unwrap()
                .set_modified(then)
                .unwrap();
            expected.push(format!("simulations-{}.csv", month(then)));
        }
        append(logs, "none", &ended()).unwrap();
        append(logs, "none", &ended()).unwrap();
        expected.push(FILE.to_owned());
        let mut sorted = expected.clone();
        sorted.sort();
        assert_eq!(names(), sorted);
        let all = "0".to_owned()..="9".to_owned();
        assert_eq!(lines(logs, &all).len(), 16);
        prune(logs, 12);
        assert!(expected[2..].iter().all(|name| names().contains(name)), "{:?}", names());
        assert!(!names().contains(&expected[0]), "{:?}", names());
        // A file of an earlier version.
        fs::write(logs.join(FILE), "id,begin\n1,2\n").unwrap();
        append(logs, "none", &ended()).unwrap();
        assert!(fs::read_to_string(logs.join(FILE)).unwrap().starts_with(HEADING));
        assert!(names().contains(&format!("simulations-{}.csv", month(SystemTime::now()))));
    }

    #[test]
    fn a_span_has_the_simulations_that_ran_in_it() {
        let folder = tempfile::tempdir().unwrap();
        let one = ended();
        append(folder.path(), "none", &one).unwrap();
        let time = |seconds| timestamp(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds));
        let (begin, end) = (one.simulation.since, one.at);
        for (from, to, is_in) in [
            (begin - 10, begin - 1, false),
            (begin - 10, begin, true),
            (begin + 10, begin + 20, true),
            (end, end + 10, true),
            (end + 1, end + 10, false),
        ] {
            assert_eq!(
                lines(folder.path(), &(time(from)..=time(to))).len(),
                usize::from(is_in),
                "{from} {to}"
            );
        }
    }

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
