//! What `POST /ready` has asked the fleet to keep ready: a list, and the file that the next run of the server reads.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use jiff::Timestamp;
use tokio::sync::{Mutex, watch};

use crate::session::config::SessionConfig;
use crate::shared::domain::ReadyEntry;

/// The entries that are not over. The registry follows them.
pub struct ReadyRequests {
    file: PathBuf,
    entries: Arc<Mutex<watch::Sender<Vec<ReadyEntry>>>>,
}

/// Most entries.
const MAX_ENTRIES: usize = 1000;

impl ReadyRequests {
    /// Reads what was requested before the last end of the server.
    pub fn open(config: &SessionConfig) -> (Self, watch::Receiver<Vec<ReadyEntry>>) {
        let file = config.log_dir.0.join("session/ready.json");
        let entries = match std::fs::read_to_string(&file) {
            Ok(text) => serde_json::from_str(&text).unwrap_or_else(|error| {
                log::warn!("{} is ignored: {error}", file.display());
                Vec::new()
            }),
            Err(_) => Vec::new(),
        };
        let (sender, receiver) = watch::channel(entries);
        let entries = Arc::new(Mutex::new(sender));
        (Self { file, entries }, receiver)
    }

    /// Adds an entry, or replaces that of the same world and mode; with `count` 0 removes it.
    ///
    /// # Errors
    /// When there are too many, or they can't be kept; as text for an administrator.
    pub async fn add(&self, entry: ReadyEntry) -> Result<(), String> {
        let entries = Arc::clone(&self.entries).lock_owned().await;
        let now = Timestamp::now();
        let mut list = entries.borrow().clone();
        list.retain(|one| !one.is_over(now) && (&one.world, one.mode) != (&entry.world, entry.mode));
        if entry.count > 0 {
            list.push(entry);
        }
        if list.len() > MAX_ENTRIES {
            return Err(format!("{MAX_ENTRIES} worlds are requested already"));
        }
        let file = self.file.clone();
        // It is done even if its client has gone meanwhile, so the file and the list stay the same.
        let kept = actix_rt::task::spawn_blocking(move || {
            write(&file, &list)?;
            entries.send_replace(list);
            std::io::Result::Ok(())
        });
        let kept = kept.await.unwrap_or_else(|error| Err(error.into()));
        kept.map_err(|error| format!("it can't be kept: {error}"))
    }
}

/// Writes the file, whole or not at all.
fn write(path: &Path, entries: &[ReadyEntry]) -> std::io::Result<()> {
    let folder = path.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder)?;
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    file.write_all(&serde_json::to_vec(entries)?)?;
    file.persist(path)?;
    Ok(())
}
