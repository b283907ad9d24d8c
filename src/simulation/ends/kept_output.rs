//! The output of simulations that have ended: its last 64 KiB, after the events of the simulation, in one file per
//! simulation.
//!
//! The files of the newest hundred abnormal ends and of the newest twenty others are kept, for two weeks at most.

use std::fs;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::ended::Ended;
use crate::simulation::simulation_id::SimulationId;

/// The directory with the output of running simulations.
pub const FOLDER_OF_RUNNING: &str = "instances";
/// The directory for normal ends.
const ENDED: &str = "ended";
/// The directory for abnormal ends.
const FAILED: &str = "failed";
/// Number of files that are kept, by directory.
const KEPT: [(&str, usize); 3] = [(FOLDER_OF_RUNNING, usize::MAX), (ENDED, 20), (FAILED, 100)];
/// Age from which a file is removed. That includes the output of a simulation whose end was not recorded because the
/// server was killed.
const AGE: Duration = Duration::from_hours(14 * 24);
/// Size of the kept output, in bytes.
const OUTPUT: u64 = 64 * 1024;

/// Returns the file with the output of the simulation with this id, whether it runs or has ended.
pub fn output_file(logs: &Path, id: &str) -> Option<PathBuf> {
    if !SimulationId::is_like(id) {
        return None;
    }
    // Kept files come first: a process that outlives its simulation may write another file.
    let files = [FAILED, ENDED, FOLDER_OF_RUNNING].map(|folder| logs.join(folder).join(format!("{id}.log")));
    files.into_iter().find(|file| file.is_file())
}

/// Keeps the end of an output, and removes the file of the running simulation.
///
/// # Errors
/// When the file can't be created. The file of the running simulation is removed nevertheless, because a full disk
/// needs the space.
pub(super) fn keep(logs: &Path, ended: &Ended) -> io::Result<()> {
    let log = logs.join(FOLDER_OF_RUNNING).join(format!("{}.log", ended.simulation.id));
    let output = last_output(&log);
    for file in [older(&log), log] {
        fs::remove_file(file).ok();
    }
    if !ended.has_output() {
        return Ok(());
    }
    let folder = logs.join(if ended.how.reason.is_abnormal() { FAILED } else { ENDED });
    fs::create_dir_all(&folder)?;
    let events = ended.events.join("\n");
    let text = format!("{events}\n\nThe last lines that it has printed:\n\n{output}");
    fs::write(folder.join(format!("{}.log", ended.simulation.id)), text)
}

/// Removes surplus and old files.
pub(super) fn prune(logs: &Path) {
    let is_old = |written| SystemTime::now().duration_since(written).is_ok_and(|age| age > AGE);
    for (folder, most) in KEPT {
        let mut all = files(&logs.join(folder));
        all.sort();
        let surplus = all.len().saturating_sub(most);
        for (number, (written, file)) in all.into_iter().enumerate() {
            if (number < surplus || is_old(written))
                && let Err(error) = fs::remove_file(&file)
            {
                log::warn!("{} can't be removed: {error}", file.display());
            }
        }
    }
}

/// The files of a directory, with the mtime of each. Empty if there is no such directory.
fn files(folder: &Path) -> Vec<(SystemTime, PathBuf)> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let about = entries.filter_map(|entry| Some((entry.metadata().ok()?, entry.path())));
    about.filter_map(|(about, path)| Some((about.is_file().then(|| about.modified().ok())??, path))).collect()
}

/// The rotated file of an output.
fn older(log: &Path) -> PathBuf {
    log.with_extension("log.1")
}

/// The last lines of an output, from its rotated file and the newest one.
fn last_output(log: &Path) -> String {
    let room = OUTPUT.saturating_sub(fs::metadata(log).map_or(0, |about| about.len()));
    let older = last_lines(&older(log), room).unwrap_or_default();
    older + &last_lines(log, OUTPUT).unwrap_or_default()
}

/// The last whole lines of a file, of at most this many bytes.
///
/// # Errors
/// When it can't be read.
pub fn last_lines(file: &Path, most: u64) -> io::Result<String> {
    let mut file = fs::File::open(file)?;
    let skipped = file.metadata()?.len().saturating_sub(most);
    file.seek(SeekFrom::Start(skipped))?;
    let mut bytes = Vec::new();
    file.take(most).read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    // A cut text begins in the middle of a line.
    let whole = if skipped > 0 { text.split_once('\n').map_or("", |(_, rest)| rest) } else { &text };
    Ok(whole.to_owned())
}

#[cfg(test)]
mod tests {
    use super::super::end_reason::EndReason;
    use super::super::ended::{End, Taken};
    use super::*;
    use crate::shared::domain::ProjectUrl;
    use crate::shared::http::Peer;
    use crate::simulation::client_identity::ClientIdentity;
    use crate::simulation::snapshot::Simulation;

    fn ended(logs: &Path, reason: EndReason) -> Ended {
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/arm.wbt").unwrap();
        let mut simulation = Simulation::new(SimulationId::next(), &world, ClientIdentity::default());
        simulation.log = Some(logs.join(FOLDER_OF_RUNNING).join(format!("{}.log", simulation.id)));
        let how = End { reason, why: String::new(), taken: Taken::default() };
        Ended {
            simulation,
            client: Peer::Proxy(std::net::Ipv4Addr::LOCALHOST.into()),
            at: 0,
            events: vec!["12:00:00 it began".to_owned()],
            how,
        }
    }

    #[test]
    fn only_the_end_of_an_output_is_kept_with_the_events() {
        let folder = tempfile::tempdir().unwrap();
        let one = ended(folder.path(), EndReason::Crashed);
        let log = one.simulation.log.clone().unwrap();
        fs::create_dir_all(log.parent().unwrap()).unwrap();
        fs::write(older(&log), "before the rotation\n".repeat(10_000)).unwrap();
        fs::write(&log, "last words\n").unwrap();
        keep(folder.path(), &one).unwrap();
        let kept = output_file(folder.path(), &one.simulation.id.to_string()).unwrap();
        let text = fs::read_to_string(&kept).unwrap();
        assert!(text.starts_with("12:00:00 it began\n\nThe last"), "{text}");
        assert!(text.ends_with("\nbefore the rotation\nlast words\n") && text.contains(":\n\nbefore"), "{text}");
        assert!((60_000..OUTPUT + 200).contains(&(text.len() as u64)), "{}", text.len());
        assert!(!log.exists() && !older(&log).exists());
    }

    #[test]
    fn files_are_bounded_by_number_and_age() {
        let folder = tempfile::tempdir().unwrap();
        let count = |name| files(&folder.path().join(name)).len();
        for _ in 0..30 {
            keep(folder.path(), &ended(folder.path(), EndReason::Left)).unwrap();
        }
        for _ in 0..110 {
            keep(folder.path(), &ended(folder.path(), EndReason::Hung)).unwrap();
        }
        prune(folder.path());
        assert_eq!((count(ENDED), count(FAILED)), (20, 100));
        let long_ago = SystemTime::now().checked_sub(AGE + Duration::from_mins(1)).unwrap();
        for (_, file) in files(&folder.path().join(FAILED)).into_iter().take(70) {
            fs::File::options().write(true).open(file).unwrap().set_modified(long_ago).unwrap();
        }
        prune(folder.path());
        assert_eq!((count(ENDED), count(FAILED)), (20, 30));
    }
}
