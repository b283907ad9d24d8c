//! The administrator's current announcement to all clients: one, or none.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use parking_lot::Mutex;
use tokio::sync::watch;

use super::config::Announcement;

/// The announcement that counts now: that of the configuration, or the one that was posted since.
pub struct Announcements {
    current: watch::Sender<Option<Arc<Announcement>>>,
    /// The one that the configuration had when it was read last: a file that still says the same changes nothing.
    configured: Mutex<Option<Announcement>>,
}

/// Longest time between two checks whether it is over: the clock may be set in between.
const CHECK_INTERVAL: Duration = Duration::from_secs(10);

impl Announcements {
    /// Begins with that of the configuration. It ends in time while the server runs.
    pub fn start(configured: Option<Announcement>) -> Self {
        let (current, changes) = watch::channel(None);
        let announcements = Self { current, configured: Mutex::new(configured.clone()) };
        announcements.set(configured);
        actix_rt::spawn(end_in_time(announcements.current.clone(), changes));
        announcements
    }

    /// Replaces it; one that is over already is none.
    pub fn set(&self, announcement: Option<Announcement>) {
        let announcement = announcement.filter(|one| !one.is_over());
        match &announcement {
            Some(Announcement { text, .. }) => log::info!("announced to everybody: {text}"),
            None => log::debug!("nothing is announced"),
        }
        self.current.send_replace(announcement.map(Arc::new));
    }

    /// Takes that of a configuration that was read again, if it is another one than before.
    pub fn reconfigure(&self, announcement: Option<Announcement>) {
        let mut configured = self.configured.lock();
        if *configured != announcement {
            configured.clone_from(&announcement);
            self.set(announcement);
        }
    }

    /// The one that counts now.
    pub fn current(&self) -> Option<Arc<Announcement>> {
        self.current.borrow().clone()
    }

    /// Follows changes.
    pub fn subscribe(&self) -> watch::Receiver<Option<Arc<Announcement>>> {
        self.current.subscribe()
    }
}

/// Ends each announcement when it is over.
async fn end_in_time(
    current: watch::Sender<Option<Arc<Announcement>>>,
    mut changes: watch::Receiver<Option<Arc<Announcement>>>,
) {
    loop {
        let until = changes.borrow_and_update().as_ref().and_then(|one| one.until);
        let left = until.map(|until| until.duration_since(SystemTime::now()).unwrap_or_default());
        tokio::select! {
            another = changes.changed() => if another.is_err() { return },
            () = actix_rt::time::sleep(left.unwrap_or_default().min(CHECK_INTERVAL)), if left.is_some() => {
                current.send_if_modified(|one| one.take_if(|one| one.is_over()).is_some());
            }
        }
    }
}
