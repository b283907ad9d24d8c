//! The output of simulations that have ended, and after it their events, in one file per simulation.
//!
//! The files of the newest hundred ends are kept, for two weeks at most.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::ended::Ended;
use crate::simulation::simulation_id::SimulationId;

/// The directory with the output of running simulations.
pub const FOLDER_OF_RUNNING: &str = "instances";
/// The directory of those that have ended.
const ENDED: &str = "ended";
/// Number of files that are kept, by directory.
const KEPT: [(&str, usize); 2] = [(FOLDER_OF_RUNNING, usize::MAX), (ENDED, 100)];
/// Age from which a file is removed. That includes the output of a simulation whose end was not recorded because the
/// server was killed.
const AGE: Duration = Duration::from_hours(14 * 24);

/// Returns the file with the output of the simulation with this id, whether it runs or has ended.
pub fn output_file(logs: &Path, id: &str) -> Option<PathBuf> {
    if !SimulationId::is_like(id) {
        return None;
    }
    // The kept file comes first: a process that outlives its simulation may create the other one again.
    let files = [ENDED, FOLDER_OF_RUNNING].map(|folder| logs.join(folder).join(format!("{id}.log")));
    files.into_iter().find(|file| file.is_file())
}

/// Keeps an output, without what was rotated away, and adds the events of the simulation.
///
/// # Errors
/// When the file can't be written.
pub(super) fn keep(logs: &Path, ended: &Ended) -> io::Result<()> {
    let name = format!("{}.log", ended.simulation.id);
    let log = logs.join(FOLDER_OF_RUNNING).join(&name);
    let kept = logs.join(ENDED).join(&name);
    fs::remove_file(log.with_extension("log.1")).ok();
    if !ended.has_output() {
        fs::remove_file(&log).ok();
        return Ok(());
    }
    fs::create_dir_all(logs.join(ENDED))?;
    // A simulation that was never launched has no output.
    fs::rename(&log, &kept).ok();
    let mut file = File::options().create(true).append(true).open(kept)?;
    write!(file, "\n\nWhat has happened:\n\n{}\n", ended.events.join("\n"))
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
    about
        .filter_map(|(about, path)| Some((about.is_file().then(|| about.modified().ok())??, path)))
        .collect()
}

/// The last whole lines of a file, of at most this many bytes.
///
/// # Errors
/// When it can't be read.
pub fn last_lines(file: &Path, most: u64) -> io::Result<String> {
    let mut file = File::open(file)?;
    let skipped = file.metadata()?.len().saturating_sub(most);
    file.seek(SeekFrom::Start(skipped))?;
    let mut bytes = Vec::new();
    file.take(most).read_to_end(&mut bytes)?;
    let text = String::from_utf8_lossy(&bytes);
    // A text that was cut begins in the middle of a line.
    let whole = if skipped > 0 {
        text.split_once('\n').map_or("", |(_, rest)| rest)
    } else {
        &text
    };
    Ok(whole.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::domain::{Failure, ProjectUrl, Reason};
    use crate::shared::http::Peer;
    use crate::simulation::client_identity::ClientIdentity;
    use crate::simulation::snapshot::Simulation;

    fn ended(logs: &Path, reason: Reason) -> Ended {
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/arm.wbt").unwrap();
        let mut simulation = Simulation::new(SimulationId::next(), &world, ClientIdentity::default());
        simulation.log = Some(logs.join(FOLDER_OF_RUNNING).join(format!("{}.log", simulation.id)));
        Ended {
            simulation,
            client: Some(Peer::Proxy(std::net::Ipv4Addr::LOCALHOST.into())),
            at: 0,
            events: vec!["12:00:00 it began".to_owned()],
            end: Failure::new(reason, "").into(),
        }
    }

    #[test]
    fn an_output_is_kept_with_the_events() {
        let folder = tempfile::tempdir().unwrap();
        let one = ended(folder.path(), Reason::Crashed);
        let log = one.simulation.log.clone().unwrap();
        fs::create_dir_all(log.parent().unwrap()).unwrap();
        fs::write(log.with_extension("log.1"), "before the rotation\n").unwrap();
        fs::write(&log, "last words\n").unwrap();
        keep(folder.path(), &one).unwrap();
        let kept = output_file(folder.path(), &one.simulation.id.to_string()).unwrap();
        let text = fs::read_to_string(&kept).unwrap();
        assert_eq!(text, "last words\n\n\nWhat has happened:\n\n12:00:00 it began\n");
        assert_eq!(files(log.parent().unwrap()).len(), 0);
    }

    #[test]
    fn files_are_bounded_by_number_and_age() {
        let folder = tempfile::tempdir().unwrap();
        let kept = folder.path().join(ENDED);
        for _ in 0..110 {
            keep(folder.path(), &ended(folder.path(), Reason::Hung)).unwrap();
        }
        prune(folder.path());
        assert_eq!(files(&kept).len(), 100);
        let long_ago = SystemTime::now().checked_sub(AGE + Duration::from_mins(1)).unwrap();
        for (_, file) in files(&kept).into_iter().take(70) {
            File::options()
                .write(true)
                .open(file)
                .unwrap()
                .set_modified(long_ago)
                .unwrap();
        }
        prune(folder.path());
        assert_eq!(files(&kept).len(), 30);
    }
}
