//! The administrator's current announcement, if there is one.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use parking_lot::Mutex;
use tokio::sync::watch;

use super::config::Announcement;

/// The current announcement: that of the configuration, or the one that was posted since.
pub struct Announcements {
    current: watch::Sender<Option<Arc<Announcement>>>,
    /// The announcement of the configuration when it was last read: an unchanged one replaces nothing.
    configured: Mutex<Option<Announcement>>,
}

/// Longest time between two checks whether it has expired, because the clock may be set.
const CHECK_INTERVAL: Duration = Duration::from_secs(10);

impl Announcements {
    /// Starts with the announcement of the configuration, and a task that removes expired ones.
    pub fn start(configured: Option<Announcement>) -> Self {
        let (current, changes) = watch::channel(None);
        let announcements = Self { current, configured: Mutex::new(configured.clone()) };
        announcements.set(configured);
        actix_rt::spawn(end_in_time(announcements.current.clone(), changes));
        announcements
    }

    /// Replaces the announcement; an expired one removes it.
    pub fn set(&self, announcement: Option<Announcement>) {
        let announcement = announcement.filter(|one| !one.is_over());
        match &announcement {
            Some(Announcement { text, .. }) => log::info!("announced to everybody: {text}"),
            None => log::debug!("nothing is announced"),
        }
        self.current.send_replace(announcement.map(Arc::new));
    }

    /// Takes the announcement of a reloaded configuration if it has changed there.
    pub fn reconfigure(&self, announcement: Option<Announcement>) {
        let mut configured = self.configured.lock();
        if *configured != announcement {
            configured.clone_from(&announcement);
            self.set(announcement);
        }
    }

    /// The current announcement.
    pub fn current(&self) -> Option<Arc<Announcement>> {
        self.current.borrow().clone()
    }

    /// Receives changes.
    pub fn subscribe(&self) -> watch::Receiver<Option<Arc<Announcement>>> {
        self.current.subscribe()
    }
}

/// Removes each announcement when it expires.
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
